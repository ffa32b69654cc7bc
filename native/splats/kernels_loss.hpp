// Structural similarity of two pictures and its derivative, with a separable Gaussian window and zeros outside.
//
//   S = (2 m_a m_b + C1)(2 s_ab + C2) / ((m_a^2 + m_b^2 + C1)(s_a + s_b + C2)),  m = G * a,  s_ab = G * ab - m_a m_b.
//
// G is its own adjoint, so the gradient is G*(S_m) + 2 a G*(S_aa) + b G*(S_ab). Wang et al. (2004).
// A row of all channels is one line of floats in which the window's taps lie `channels` floats apart, so pictures are
// read as they are. Columns are blurred first: the five products of a row then live in the nearest cache only.
#pragma once

#include "core/vector.hpp"
#include "splats/constants.hpp"
#include "splats/kernels.hpp"

namespace {

using namespace rf3dgs;

// Floats of a picture's column strip one vector wide; a strip that ends beyond the picture is copied and filled with
// zeros.
struct Strip {
  const float* at;  // the row that the strip starts with
  int stride;
  alignas(64) float copy[kSsimTaps * kLanes];

  RF_INLINE Strip(const float* picture, int first, int rows, int length, int x) {
    at = picture + static_cast<size_t>(first) * length + x;
    stride = length;
    if (length - x >= kLanes) return;
    for (int row = 0; row < rows; ++row) {
      for (int lane = 0; lane < kLanes; ++lane) {
        copy[row * kLanes + lane] = x + lane < length ? at[static_cast<size_t>(row) * length + lane] : 0.0f;
      }
    }
    at = copy;
    stride = kLanes;
  }
  RF_INLINE Vec operator[](int row) const { return load(at + static_cast<size_t>(row) * stride); }
};

// The lines of scratch memory, with the window's reach of zeros on both sides.
struct Lines {
  float* first;
  int reach, stride;

  RF_INLINE float* operator[](int line) const { return first + line * stride + reach; }
};

RF_INLINE Lines zero_sided_lines(const PicturePair& pair, int count, float* scratch) {
  const Lines lines = {scratch, kSsimRadius * pair.channels, loss_line(pair.width, pair.channels)};
  for (int line = 0; line < count; ++line) {
    std::memset(lines[line] - lines.reach, 0, lines.reach * sizeof(float));
    std::memset(lines[line] + pair.width * pair.channels, 0, (lines.reach + kLanes) * sizeof(float));
  }
  return lines;
}

// The weight of every float of a row.
RF_INLINE void write_shares(const PicturePair& pair, int row, float* shares) {
  const float* weight = pair.weight == nullptr ? nullptr : pair.weight + static_cast<size_t>(row) * pair.width;
  for (int x = 0; x < pair.width; ++x) {
    for (int channel = 0; channel < pair.channels; ++channel) {
      shares[x * pair.channels + channel] = weight == nullptr ? 1.0f : weight[x];
    }
  }
}

RF_INLINE Vec blur_along_row(const PicturePair& pair, const float* at) {
  Vec sum = pair.window[0] * load(at - kSsimRadius * pair.channels);
  for (int tap = 1; tap < kSsimTaps; ++tap) sum += pair.window[tap] * load(at + (tap - kSsimRadius) * pair.channels);
  return sum;
}

LossSums ssim_row(const PicturePair& pair, int row, float* const partial[3], float* scratch) {
  const int length = pair.width * pair.channels;
  const int first = row < kSsimRadius ? kSsimRadius - row : 0;
  const int last = row + kSsimRadius < pair.height ? kSsimTaps : pair.height - row + kSsimRadius;
  const Lines lines = zero_sided_lines(pair, 6, scratch);
  write_shares(pair, row, lines[5]);
  for (int x = 0; x < length; x += kLanes) {
    const Strip strip_a(pair.a, row + first - kSsimRadius, last - first, length, x);
    const Strip strip_b(pair.b, row + first - kSsimRadius, last - first, length, x);
    Vec a = {}, b = {}, aa = {}, bb = {}, ab = {};
    for (int tap = first; tap < last; ++tap) {
      const Vec from_a = strip_a[tap - first], from_b = strip_b[tap - first];
      const Vec part_a = pair.window[tap] * from_a, part_b = pair.window[tap] * from_b;
      a += part_a;
      b += part_b;
      aa += part_a * from_a;
      bb += part_b * from_b;
      ab += part_a * from_b;
    }
    store(lines[0] + x, a);
    store(lines[1] + x, b);
    store(lines[2] + x, aa);
    store(lines[3] + x, bb);
    store(lines[4] + x, ab);
  }
  Vec ssim = {}, l1 = {};
  for (int x = 0; x < length; x += kLanes) {
    const Vec ma = blur_along_row(pair, lines[0] + x), mb = blur_along_row(pair, lines[1] + x);
    const Vec aa = blur_along_row(pair, lines[2] + x), bb = blur_along_row(pair, lines[3] + x);
    const Vec ab = blur_along_row(pair, lines[4] + x), share = load(lines[5] + x);
    const Vec a1 = 2.0f * ma * mb + kSsimC1, a2 = 2.0f * (ab - ma * mb) + kSsimC2;
    const Vec b1 = ma * ma + mb * mb + kSsimC1, b2 = (aa - ma * ma) + (bb - mb * mb) + kSsimC2;
    const Vec inverse = 1.0f / (b1 * b2);
    const Vec s = a1 * a2 * inverse, s_b1 = s * inverse * b2, s_b2 = s * inverse * b1;
    ssim += share * s;
    store(partial[0] + x, share * 2.0f * (mb * (a2 - a1) * inverse + ma * (s_b2 - s_b1)));
    store(partial[1] + x, 0.0f - share * s_b2);
    store(partial[2] + x, share * 2.0f * a1 * inverse);
    const Vec difference = Strip(pair.a, row, 1, length, x)[0] - Strip(pair.b, row, 1, length, x)[0];
    l1 += share * max_vec(difference, 0.0f - difference);
  }
  return {sum_of(ssim), sum_of(l1)};
}

void ssim_gradient_row(const PicturePair& pair, int row, const float* const partial[3], float l1_scale,
                       float ssim_scale, float* gradient, float* scratch) {
  const int length = pair.width * pair.channels, stride = loss_stride(pair.width, pair.channels);
  const int first = row < kSsimRadius ? kSsimRadius - row : 0;
  const int last = row + kSsimRadius < pair.height ? kSsimTaps : pair.height - row + kSsimRadius;
  const Lines lines = zero_sided_lines(pair, 4, scratch);
  write_shares(pair, row, lines[3]);
  for (int x = 0; x < length; x += kLanes) {
    for (int map = 0; map < 3; ++map) {
      const float* from = partial[map] + static_cast<size_t>(row + first - kSsimRadius) * stride + x;
      Vec sum = {};
      for (int tap = first; tap < last; ++tap, from += stride) sum += pair.window[tap] * load(from);
      store(lines[map] + x, sum);
    }
  }
  for (int x = 0; x < length; x += kLanes) {
    const Vec a = Strip(pair.a, row, 1, length, x)[0], b = Strip(pair.b, row, 1, length, x)[0];
    const Vec along = blur_along_row(pair, lines[0] + x) + 2.0f * a * blur_along_row(pair, lines[1] + x) +
                      b * blur_along_row(pair, lines[2] + x);
    const Vec one = splat_vec(l1_scale);
    const Vec sign = select(a > b, one, select(a < b, 0.0f - one, Vec{}));
    const Vec result = load(lines[3] + x) * sign + ssim_scale * along;
    float* to = gradient + static_cast<size_t>(row) * length + x;
    if (length - x >= kLanes) {
      store(to, result);
    } else {
      for (int lane = 0; lane < length - x; ++lane) to[lane] = result[lane];
    }
  }
}

}  // namespace
