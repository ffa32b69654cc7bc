// Structural similarity of two pictures and its derivative, with a separable Gaussian window and zeros outside.
//
//   S = (2 m_a m_b + C1)(2 s_ab + C2) / ((m_a^2 + m_b^2 + C1)(s_a + s_b + C2)),  m = G * a,  s_ab = G * ab - m_a m_b.
//
// G is its own adjoint, so the gradient is G*(S_m) + 2 a G*(S_aa) + b G*(S_ab). Wang et al. (2004).
// A row of all channels is one line of floats in which the window's taps lie `channels` floats apart, so pictures are
// read as they are. Columns are blurred first: the products of a row then live in the nearest cache only. What depends
// on the second picture alone, G * b and G * bb, may be known already.
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

// The rows of the window that lie in the picture.
struct Taps {
  int first, last;
  RF_INLINE Taps(const PicturePair& pair, int row)
      : first(row < kSsimRadius ? kSsimRadius - row : 0),
        last(row + kSsimRadius < pair.height ? kSsimTaps : pair.height - row + kSsimRadius) {}
};

// Columns of b and bb, blurred.
RF_INLINE void blur_target_columns(const PicturePair& pair, const Taps& taps, int row, int x, float* to_b, float* to_bb) {
  const Strip strip(pair.b, row + taps.first - kSsimRadius, taps.last - taps.first, pair.width * pair.channels, x);
  Vec b = {}, bb = {};
  for (int tap = taps.first; tap < taps.last; ++tap) {
    const Vec from = strip[tap - taps.first], part = pair.window[tap] * from;
    b += part;
    bb += part * from;
  }
  store(to_b, b);
  store(to_bb, bb);
}

void target_row(const PicturePair& pair, int row, float* mean, float* square, float* scratch) {
  const int length = pair.width * pair.channels;
  const Lines lines = zero_sided_lines(pair, 2, scratch);
  const Taps taps(pair, row);
  for (int x = 0; x < length; x += kLanes) blur_target_columns(pair, taps, row, x, lines[0] + x, lines[1] + x);
  for (int x = 0; x < length; x += kLanes) {
    store(mean + x, blur_along_row(pair, lines[0] + x));
    store(square + x, blur_along_row(pair, lines[1] + x));
  }
}

LossSums l1_row(const PicturePair& pair, int row, float* const[3], float* scratch) {
  const int length = pair.width * pair.channels;
  const Lines lines = zero_sided_lines(pair, 1, scratch);
  write_shares(pair, row, lines[0]);
  Vec l1 = {};
  for (int x = 0; x < length; x += kLanes) {
    const Vec difference = Strip(pair.a, row, 1, length, x)[0] - Strip(pair.b, row, 1, length, x)[0];
    l1 += load(lines[0] + x) * max_vec(difference, 0.0f - difference);
  }
  return {0.0f, sum_of(l1)};
}

LossSums ssim_row(const PicturePair& pair, int row, float* const partial[3], float* scratch) {
  const int length = pair.width * pair.channels;
  const Taps taps(pair, row);
  const Lines lines = zero_sided_lines(pair, 6, scratch);
  write_shares(pair, row, lines[5]);
  const bool known = pair.mean != nullptr && !pair.is_composed[row];
  const size_t place = static_cast<size_t>(row) * loss_stride(pair.width, pair.channels);
  for (int x = 0; x < length; x += kLanes) {
    const Strip strip_a(pair.a, row + taps.first - kSsimRadius, taps.last - taps.first, length, x);
    const Strip strip_b(pair.b, row + taps.first - kSsimRadius, taps.last - taps.first, length, x);
    Vec a = {}, aa = {}, ab = {};
    for (int tap = taps.first; tap < taps.last; ++tap) {
      const Vec from_a = strip_a[tap - taps.first], part_a = pair.window[tap] * from_a;
      a += part_a;
      aa += part_a * from_a;
      ab += part_a * strip_b[tap - taps.first];
    }
    store(lines[0] + x, a);
    store(lines[2] + x, aa);
    store(lines[4] + x, ab);
    if (!known) blur_target_columns(pair, taps, row, x, lines[1] + x, lines[3] + x);
  }
  Vec ssim = {}, l1 = {};
  for (int x = 0; x < length; x += kLanes) {
    const Vec ma = blur_along_row(pair, lines[0] + x), aa = blur_along_row(pair, lines[2] + x);
    const Vec ab = blur_along_row(pair, lines[4] + x), share = load(lines[5] + x);
    const Vec mb = known ? load(pair.mean + place + x) : blur_along_row(pair, lines[1] + x);
    const Vec bb = known ? load(pair.square + place + x) : blur_along_row(pair, lines[3] + x);
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

// Share times the sign of a - b, scaled, and what `along` says.
RF_INLINE void write_gradient(const PicturePair& pair, int row, int x, Vec share, float l1_scale, Vec along, float* gradient) {
  const int length = pair.width * pair.channels;
  const Vec a = Strip(pair.a, row, 1, length, x)[0], b = Strip(pair.b, row, 1, length, x)[0];
  const Vec one = splat_vec(l1_scale);
  const Vec sign = select(a > b, one, select(a < b, 0.0f - one, Vec{}));
  const Vec result = share * sign + along;
  float* to = gradient + static_cast<size_t>(row) * length + x;
  if (length - x >= kLanes) {
    store(to, result);
  } else {
    for (int lane = 0; lane < length - x; ++lane) to[lane] = result[lane];
  }
}

void l1_gradient_row(const PicturePair& pair, int row, const float* const[3], float l1_scale, float, float* gradient,
                     float* scratch) {
  const Lines lines = zero_sided_lines(pair, 1, scratch);
  write_shares(pair, row, lines[0]);
  for (int x = 0; x < pair.width * pair.channels; x += kLanes) {
    write_gradient(pair, row, x, load(lines[0] + x), l1_scale, Vec{}, gradient);
  }
}

void ssim_gradient_row(const PicturePair& pair, int row, const float* const partial[3], float l1_scale,
                       float ssim_scale, float* gradient, float* scratch) {
  const int length = pair.width * pair.channels, stride = loss_stride(pair.width, pair.channels);
  const Taps taps(pair, row);
  const Lines lines = zero_sided_lines(pair, 4, scratch);
  write_shares(pair, row, lines[3]);
  for (int x = 0; x < length; x += kLanes) {
    for (int map = 0; map < 3; ++map) {
      const float* from = partial[map] + static_cast<size_t>(row + taps.first - kSsimRadius) * stride + x;
      Vec sum = {};
      for (int tap = taps.first; tap < taps.last; ++tap, from += stride) sum += pair.window[tap] * load(from);
      store(lines[map] + x, sum);
    }
  }
  for (int x = 0; x < length; x += kLanes) {
    const Vec a = Strip(pair.a, row, 1, length, x)[0], b = Strip(pair.b, row, 1, length, x)[0];
    const Vec along = blur_along_row(pair, lines[0] + x) + 2.0f * a * blur_along_row(pair, lines[1] + x) +
                      b * blur_along_row(pair, lines[2] + x);
    write_gradient(pair, row, x, load(lines[3] + x), l1_scale, ssim_scale * along, gradient);
  }
}

}  // namespace
