// Structural similarity of two pictures and its derivative, with a separable Gaussian window and zeros outside.
//
//   S = (2 m_a m_b + C1)(2 s_ab + C2) / ((m_a^2 + m_b^2 + C1)(s_a + s_b + C2)),  m = G * a,  s_ab = G * ab - m_a m_b.
//
// G is its own adjoint, so the gradient is G*(S_m) + 2 a G*(S_aa) + b G*(S_ab). Wang et al. (2004).
#pragma once

#include "core/vector.hpp"
#include "splats/constants.hpp"
#include "splats/kernels.hpp"

namespace {

using namespace rf3dgs;

constexpr int kTaps = 2 * kSsimRadius + 1;

struct Window {
  float tap[kTaps];
};

RF_INLINE Window ssim_window() {
  Window window;
  double total = 0.0;
  for (int at = 0; at < kTaps; ++at) {
    const double distance = at - kSsimRadius;
    total += __builtin_exp(-0.5 * distance * distance / (double(kSsimSigma) * kSsimSigma));
  }
  for (int at = 0; at < kTaps; ++at) {
    const double distance = at - kSsimRadius;
    window.tap[at] =
        static_cast<float>(__builtin_exp(-0.5 * distance * distance / (double(kSsimSigma) * kSsimSigma)) / total);
  }
  return window;
}

// `padded` holds kSsimRadius zeros on both sides of the row.
RF_INLINE void blur_row(const Window& window, const float* __restrict padded, int width, float* __restrict out) {
  for (int x = 0; x < width; ++x) {
    float sum = 0.0f;
    for (int at = 0; at < kTaps; ++at) sum += window.tap[at] * padded[x + at];
    out[x] = sum;
  }
}

RF_INLINE void blur_column(const Window& window, const float* plane, int row, int width, int height,
                           float* __restrict out) {
  for (int x = 0; x < width; ++x) out[x] = 0.0f;
  for (int at = 0; at < kTaps; ++at) {
    const int from = row + at - kSsimRadius;
    if (from < 0 || from >= height) continue;
    const float* __restrict line = plane + static_cast<size_t>(from) * width;
    const float tap = window.tap[at];
    for (int x = 0; x < width; ++x) out[x] += tap * line[x];
  }
}

void ssim_row(const float* a, const float* b, int width, int channels, float* const out[5], float* scratch) {
  const Window window = ssim_window();
  const int stride = width + 32;
  float* lines[5];
  for (int map = 0; map < 5; ++map) {
    lines[map] = scratch + map * stride;
    for (int x = 0; x < kSsimRadius; ++x) lines[map][x] = lines[map][width + kSsimRadius + x] = 0.0f;
  }
  for (int x = 0; x < width; ++x) {
    const float first = a[x * channels], second = b[x * channels];
    lines[0][x + kSsimRadius] = first;
    lines[1][x + kSsimRadius] = second;
    lines[2][x + kSsimRadius] = first * first;
    lines[3][x + kSsimRadius] = second * second;
    lines[4][x + kSsimRadius] = first * second;
  }
  for (int map = 0; map < 5; ++map) blur_row(window, lines[map], width, out[map]);
}

double ssim_column(const float* const in[5], int row, int width, int height, const float* weight, float* const out[3],
                   float* scratch) {
  const Window window = ssim_window();
  const int stride = width + 32;
  float* map[5];
  for (int at = 0; at < 5; ++at) {
    map[at] = scratch + at * stride;
    blur_column(window, in[at], row, width, height, map[at]);
  }
  double total = 0.0;
  for (int x = 0; x < width; ++x) {
    const float ma = map[0][x], mb = map[1][x];
    const float a1 = 2.0f * ma * mb + kSsimC1, a2 = 2.0f * (map[4][x] - ma * mb) + kSsimC2;
    const float b1 = ma * ma + mb * mb + kSsimC1;
    const float b2 = (map[2][x] - ma * ma) + (map[3][x] - mb * mb) + kSsimC2;
    const float inverse = 1.0f / (b1 * b2);
    const float s = a1 * a2 * inverse;
    const float share = weight != nullptr ? weight[x] : 1.0f;
    map[0][x] = share * s;
    out[0][x] = share * (2.0f * mb * (a2 - a1) * inverse - 2.0f * ma * s / b1 + 2.0f * ma * s / b2);
    out[1][x] = -share * s / b2;
    out[2][x] = share * 2.0f * a1 * inverse;
  }
  for (int x = 0; x < width; ++x) total += map[0][x];
  return total;
}

void ssim_gradient_row(const float* const in[3], int row, int width, int height, const float* a, const float* b,
                       int channels, const float* weight, float l1_scale, float ssim_scale, float* gradient,
                       float* scratch) {
  const Window window = ssim_window();
  const int stride = width + 32;
  float* map[3];
  for (int at = 0; at < 3; ++at) {
    float* line = scratch + 3 * stride;
    for (int x = 0; x < kSsimRadius; ++x) line[x] = line[width + kSsimRadius + x] = 0.0f;
    blur_column(window, in[at], row, width, height, line + kSsimRadius);
    map[at] = scratch + at * stride;
    blur_row(window, line, width, map[at]);
  }
  for (int x = 0; x < width; ++x) {
    const float first = a[x * channels], second = b[x * channels];
    const float share = weight != nullptr ? weight[x] : 1.0f;
    const float sign = static_cast<float>(first > second) - static_cast<float>(first < second);
    gradient[x * channels] =
        l1_scale * share * sign + ssim_scale * (map[0][x] + 2.0f * first * map[1][x] + second * map[2][x]);
  }
}

}  // namespace
