// Real spherical harmonics up to degree 3 in the order and with the signs of 3DGS.
#pragma once

#include "core/vector.hpp"
#include "splats/kernels.hpp"

namespace {

using namespace rf3dgs;

RF_INLINE void basis_of(const float* directions, int bases, float* out) {
  const float x = directions[0], y = directions[1], z = directions[2];
  out[0] = 0.28209479177387814f;
  if (bases < 4) return;
  out[1] = -0.4886025119029199f * y;
  out[2] = 0.4886025119029199f * z;
  out[3] = -0.4886025119029199f * x;
  if (bases < 9) return;
  const float xx = x * x, yy = y * y, zz = z * z;
  out[4] = 1.0925484305920792f * x * y;
  out[5] = -1.0925484305920792f * y * z;
  out[6] = 0.31539156525252005f * (2.0f * zz - xx - yy);
  out[7] = -1.0925484305920792f * x * z;
  out[8] = 0.5462742152960396f * (xx - yy);
  if (bases < 16) return;
  out[9] = -0.5900435899266435f * y * (3.0f * xx - yy);
  out[10] = 2.890611442640554f * x * y * z;
  out[11] = -0.4570457994644658f * y * (4.0f * zz - xx - yy);
  out[12] = 0.3731763325901154f * z * (2.0f * zz - 3.0f * xx - 3.0f * yy);
  out[13] = -0.4570457994644658f * x * (4.0f * zz - xx - yy);
  out[14] = 1.445305721320277f * z * (xx - yy);
  out[15] = -0.5900435899266435f * x * (xx - 3.0f * yy);
}

// Sums the coefficients of C channels with the basis unrolled in the compiler's hands.
template <int C>
void harmonics_of(const float* sh, const float* directions, int bases, size_t begin, size_t end, float* out) {
  for (size_t at = begin; at < end; ++at) {
    float basis[16];
    basis_of(directions + 3 * at, bases, basis);
    const float* from = sh + at * bases * C;
    float sum[C] = {};
    for (int k = 0; k < bases; ++k) {
      for (int channel = 0; channel < C; ++channel) sum[channel] += basis[k] * from[k * C + channel];
    }
    for (int channel = 0; channel < C; ++channel) out[at * C + channel] = sum[channel];
  }
}

void harmonics(const float* sh, const float* directions, int bases, int channels, size_t begin, size_t end, float* out) {
  switch (channels) {
    case 1: return harmonics_of<1>(sh, directions, bases, begin, end, out);
    case 3: return harmonics_of<3>(sh, directions, bases, begin, end, out);
    case 4: return harmonics_of<4>(sh, directions, bases, begin, end, out);
    default: break;
  }
  for (size_t at = begin; at < end; ++at) {
    float basis[16];
    basis_of(directions + 3 * at, bases, basis);
    for (int channel = 0; channel < channels; ++channel) {
      float sum = 0.0f;
      for (int k = 0; k < bases; ++k) sum += basis[k] * sh[(at * bases + k) * channels + channel];
      out[at * channels + channel] = sum;
    }
  }
}

void harmonics_backward(const float* gradient, const float* directions, int bases, int channels, size_t begin, size_t end,
                        float* out) {
  for (size_t at = begin; at < end; ++at) {
    float basis[16];
    basis_of(directions + 3 * at, bases, basis);
    float* to = out + at * bases * channels;
    const float* of = gradient + at * channels;
    for (int k = 0; k < bases; ++k) {
      for (int channel = 0; channel < channels; ++channel) to[k * channels + channel] = basis[k] * of[channel];
    }
  }
}

}  // namespace
