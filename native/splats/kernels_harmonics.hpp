// Real spherical harmonics up to degree 3 in the order and with the signs of 3DGS.
//
// The basis is computed for sixteen directions at once; the coefficients of one Gaussian lie together and are read or
// written four floats at a time where there are three or four channels.
#pragma once

#include "core/vector.hpp"
#include "splats/kernels.hpp"

namespace {

using namespace rf3dgs;

// The basis at sixteen unit vectors.
RF_INLINE void basis_at(Vec x, Vec y, Vec z, int bases, Vec* out) {
  out[0] = splat_vec(0.28209479177387814f);
  if (bases < 4) return;
  out[1] = -0.4886025119029199f * y;
  out[2] = 0.4886025119029199f * z;
  out[3] = -0.4886025119029199f * x;
  if (bases < 9) return;
  const Vec xx = x * x, yy = y * y, zz = z * z;
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

// `out` is [bases, lane] for the directions [begin, begin + lanes).
RF_INLINE void basis_of(const float* directions, size_t begin, int lanes, int bases, float (*out)[kLanes]) {
  alignas(64) float part[3][kLanes] = {};
  for (int lane = 0; lane < lanes; ++lane) {
    for (int axis = 0; axis < 3; ++axis) part[axis][lane] = directions[3 * (begin + lane) + axis];
  }
  Vec basis[16];
  basis_at(load(part[0]), load(part[1]), load(part[2]), bases, basis);
  for (int k = 0; k < bases; ++k) store(out[k], basis[k]);
}

// The first C of four floats; the others are read and written only where there is something behind them.
template <int C>
RF_INLINE Four load_channels(const float* from, bool last) {
  Four result = {};
  std::memcpy(&result, from, (last ? C : 4) * sizeof(float));
  return result;
}

template <int C>
void harmonics_of(const float* sh, const float* directions, int bases, size_t begin, size_t end, float* out) {
  alignas(64) float basis[16][kLanes];
  for (size_t start = begin; start < end; start += kLanes) {
    const int lanes = static_cast<int>(end - start < kLanes ? end - start : kLanes);
    basis_of(directions, start, lanes, bases, basis);
    for (int lane = 0; lane < lanes; ++lane) {
      const float* from = sh + (start + lane) * bases * C;
      Four sum = {};
      for (int k = 0; k < bases - 1; ++k) sum += basis[k][lane] * load_channels<C>(from + k * C, false);
      sum += basis[bases - 1][lane] * load_channels<C>(from + (bases - 1) * C, true);
      std::memcpy(out + (start + lane) * C, &sum, C * sizeof(float));
    }
  }
}

template <int C>
void harmonics_backward_of(const float* gradient, const float* directions, int bases, size_t begin, size_t end,
                           float* out) {
  alignas(64) float basis[16][kLanes];
  for (size_t start = begin; start < end; start += kLanes) {
    const int lanes = static_cast<int>(end - start < kLanes ? end - start : kLanes);
    basis_of(directions, start, lanes, bases, basis);
    for (int lane = 0; lane < lanes; ++lane) {
      const Four of = load_channels<C>(gradient + (start + lane) * C, true);
      float* to = out + (start + lane) * bases * C;
      for (int k = 0; k < bases - 1; ++k) {
        const Four part = basis[k][lane] * of;
        std::memcpy(to + k * C, &part, sizeof(part));
      }
      const Four part = basis[bases - 1][lane] * of;
      std::memcpy(to + (bases - 1) * C, &part, C * sizeof(float));
    }
  }
}

void harmonics(const float* sh, const float* directions, int bases, int channels, size_t begin, size_t end,
               float* out) {
  if (channels == 3) return harmonics_of<3>(sh, directions, bases, begin, end, out);
  if (channels == 4) return harmonics_of<4>(sh, directions, bases, begin, end, out);
  alignas(64) float basis[16][kLanes];
  for (size_t start = begin; start < end; start += kLanes) {
    const int lanes = static_cast<int>(end - start < kLanes ? end - start : kLanes);
    basis_of(directions, start, lanes, bases, basis);
    for (int lane = 0; lane < lanes; ++lane) {
      const size_t at = start + lane;
      for (int channel = 0; channel < channels; ++channel) {
        double sum = 0.0;  // sixteen terms may cancel
        for (int k = 0; k < bases; ++k) {
          sum += static_cast<double>(basis[k][lane]) * sh[(at * bases + k) * channels + channel];
        }
        out[at * channels + channel] = static_cast<float>(sum);
      }
    }
  }
}

void harmonics_backward(const float* gradient, const float* directions, int bases, int channels, size_t begin,
                        size_t end, float* out) {
  if (channels == 3) return harmonics_backward_of<3>(gradient, directions, bases, begin, end, out);
  if (channels == 4) return harmonics_backward_of<4>(gradient, directions, bases, begin, end, out);
  alignas(64) float basis[16][kLanes];
  for (size_t start = begin; start < end; start += kLanes) {
    const int lanes = static_cast<int>(end - start < kLanes ? end - start : kLanes);
    basis_of(directions, start, lanes, bases, basis);
    for (int lane = 0; lane < lanes; ++lane) {
      float* to = out + (start + lane) * bases * channels;
      const float* of = gradient + (start + lane) * channels;
      for (int k = 0; k < bases; ++k) {
        for (int channel = 0; channel < channels; ++channel) to[k * channels + channel] = basis[k][lane] * of[channel];
      }
    }
  }
}

}  // namespace
