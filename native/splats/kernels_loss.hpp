// Structural similarity of two pictures and its derivative, with a separable Gaussian window and zeros outside.
//
//   S = (2 m_a m_b + C1)(2 s_ab + C2) / ((m_a^2 + m_b^2 + C1)(s_a + s_b + C2)),  m = G * a,  s_ab = G * ab - m_a m_b.
//
// G is its own adjoint, so the gradient is G*(S_m) + 2 a G*(S_aa) + b G*(S_ab). Wang et al. (2004).
// A row of all channels is one line of floats in which the window's taps lie `channels` floats apart, so pictures are
// read as they are. Columns are blurred first, for a band of `kLossRows` rows at once: a band reads eighteen rows where
// eight single ones would read eighty-eight. Their lines then lie in a cache near by and are blurred along the row. The
// window is symmetric: two values that weigh the same are added before they are multiplied. What depends on the second
// picture alone, G * b and G * bb, may be known already.
#pragma once

#include <type_traits>

#include "core/vector.hpp"
#include "splats/constants.hpp"
#include "splats/kernels.hpp"

namespace {

using namespace rf3dgs;

constexpr int kSeenRows = kLossRows + 2 * kSsimRadius;

// A band of rows and the lines of scratch memory that it works on, each with zeros on both sides and padded with zeros
// to whole vectors.
struct LossBand {
  const PicturePair& pair;
  int first, rows;
  int length, stride;  // floats of a picture's row, and of the same in whole vectors
  float* scratch;
  const float* nothing;
  float* shares;

  LossBand(const PicturePair& of, int first_row, int row_count, float* memory)
      : pair(of), first(first_row), rows(row_count), length(of.width * of.channels),
        stride(loss_stride(of.width, of.channels)), scratch(memory) {
    float* const zeros = line(kLossMaps - 1, kLossRows);
    std::memset(zeros, 0, stride * sizeof(float));
    nothing = zeros;
    shares = zeros + stride;
  }

  float* line(int map, int row) const {
    const int pad = loss_pad(pair.channels);
    return scratch + static_cast<size_t>(map * kLossRows + row) * (stride + 2 * pad) + pad;
  }
  void clear_sides(int maps) const {
    const int pad = loss_pad(pair.channels);
    for (int at = 0; at < maps * kLossRows; ++at) {
      float* const middle = line(at / kLossRows, at % kLossRows);
      std::memset(middle - pad, 0, pad * sizeof(float));
      std::memset(middle + stride, 0, pad * sizeof(float));
    }
  }
  // The rows that the windows of the band see; those beside the picture are zero.
  void seen(const float* picture, size_t floats, const float** out) const {
    for (int at = 0; at < kSeenRows; ++at) {
      const int row = first - kSsimRadius + at;
      out[at] = row < 0 || row >= pair.height ? nothing : picture + row * floats;
    }
  }
  // The weight of every float of a row, zero where it is padded.
  void write_shares(int row) const {
    const float* weight = pair.weight == nullptr ? nullptr : pair.weight + static_cast<size_t>(row) * pair.width;
    for (int at = length; at < stride; ++at) shares[at] = 0.0f;
    if (weight == nullptr) {
      for (int at = 0; at < length; ++at) shares[at] = 1.0f;
      return;
    }
    float* to = shares;
    for (int x = 0; x < pair.width; ++x) {
      for (int channel = 0; channel < pair.channels; ++channel) *to++ = weight[x];
    }
  }
  // Calls work(x, floats that are there) for every vector of a row.
  template <class Work>
  RF_INLINE void each_vector(Work work) const {
    for (int x = 0; x + kLanes <= length; x += kLanes) work(x, kLanes);
    if (length % kLanes != 0) work(length / kLanes * kLanes, length % kLanes);
  }
};

// The columns of a band, blurred, from all rows that it sees.
RF_INLINE void blur_columns(const LossBand& band, const Vec* seen, int map, int x) {
  const float* const window = band.pair.window;
  for (int row = 0; row < kLossRows; ++row) {
    const Vec* const middle = seen + row + kSsimRadius;
    Vec sum = window[kSsimRadius] * middle[0];
    for (int k = 1; k <= kSsimRadius; ++k) {
      sum = mul_add(splat_vec(window[kSsimRadius - k]), middle[-k] + middle[k], sum);
    }
    store(band.line(map, row) + x, sum);
  }
}

// Sixteen floats of a line, blurred along it. C is the number of channels where the reach of the window is at most one
// vector, else 0: then the neighbours are shifted into place, which is faster than to load them across cache lines.
template <int C>
RF_INLINE Vec blur_along(const PicturePair& pair, const float* at) {
  const float* const window = pair.window;
#if defined(__AVX512F__)
  if constexpr (C > 0) {
    const Vec here = load(at), before = load(at - kLanes), after = load(at + kLanes);
    Vec sum = window[kSsimRadius] * here;
    const auto add = [&]<int k>(std::integral_constant<int, k>) {
      const Vec both = shifted<kLanes - k * C>(before, here) + shifted<k * C>(here, after);
      sum = mul_add(splat_vec(window[kSsimRadius - k]), both, sum);
    };
    add(std::integral_constant<int, 1>()), add(std::integral_constant<int, 2>()), add(std::integral_constant<int, 3>());
    add(std::integral_constant<int, 4>()), add(std::integral_constant<int, 5>());
    return sum;
  }
#endif
  const int step = C > 0 ? C : pair.channels;
  Vec sum = window[kSsimRadius] * load(at);
  for (int k = 1; k <= kSsimRadius; ++k) {
    sum = mul_add(splat_vec(window[kSsimRadius - k]), load(at - k * step) + load(at + k * step), sum);
  }
  return sum;
}

// The blurred columns of b and bb, in these maps.
void blur_target(const LossBand& band, int map_b, int map_bb) {
  const float* rows[kSeenRows];
  band.seen(band.pair.b, band.length, rows);
  band.each_vector([&](int x, int floats) {
    Vec seen[kSeenRows];
    for (int at = 0; at < kSeenRows; ++at) seen[at] = load_first(rows[at] + x, floats);
    blur_columns(band, seen, map_b, x);
    for (Vec& value : seen) value = value * value;
    blur_columns(band, seen, map_bb, x);
  });
}

template <int C>
void target_rows_of(const PicturePair& pair, int first, int rows, float* mean, float* square, float* scratch) {
  const LossBand band(pair, first, rows, scratch);
  band.clear_sides(2);
  blur_target(band, 0, 1);
  for (int row = 0; row < rows; ++row) {
    for (int x = 0; x < band.stride; x += kLanes) {
      const size_t place = static_cast<size_t>(first + row) * band.stride + x;
      store(mean + place, blur_along<C>(pair, band.line(0, row) + x));
      store(square + place, blur_along<C>(pair, band.line(1, row) + x));
    }
  }
}

template <int C>
void ssim_rows_of(const PicturePair& pair, int first, int rows, float* const partial[3], LossSums* sums,
                  float* scratch) {
  const LossBand band(pair, first, rows, scratch);
  bool known = pair.mean != nullptr;
  for (int row = 0; row < rows; ++row) known = known && !pair.is_composed[first + row];
  band.clear_sides(known ? 3 : 5);
  const float *rows_a[kSeenRows], *rows_b[kSeenRows];
  band.seen(pair.a, band.length, rows_a);
  band.seen(pair.b, band.length, rows_b);
  band.each_vector([&](int x, int floats) {
    Vec seen[kSeenRows];
    for (int at = 0; at < kSeenRows; ++at) {
      seen[at] = load_first(rows_a[at] + x, floats) * load_first(rows_b[at] + x, floats);
    }
    blur_columns(band, seen, 2, x);
    for (int at = 0; at < kSeenRows; ++at) seen[at] = load_first(rows_a[at] + x, floats);
    blur_columns(band, seen, 0, x);
    for (Vec& value : seen) value = value * value;
    blur_columns(band, seen, 1, x);
  });
  if (!known) blur_target(band, 3, 4);
  if (pair.weight == nullptr) band.write_shares(first);
  for (int row = 0; row < rows; ++row) {
    if (pair.weight != nullptr) band.write_shares(first + row);
    const bool row_known = pair.mean != nullptr && !pair.is_composed[first + row];
    const size_t place = static_cast<size_t>(first + row) * band.stride;
    const float* const a = rows_a[row + kSsimRadius];
    const float* const b = rows_b[row + kSsimRadius];
    Vec ssim = {}, l1 = {};
    band.each_vector([&](int x, int floats) {
      const Vec ma = blur_along<C>(pair, band.line(0, row) + x), aa = blur_along<C>(pair, band.line(1, row) + x);
      const Vec ab = blur_along<C>(pair, band.line(2, row) + x), share = load(band.shares + x);
      const Vec mb = row_known ? load(pair.mean + place + x) : blur_along<C>(pair, band.line(3, row) + x);
      const Vec bb = row_known ? load(pair.square + place + x) : blur_along<C>(pair, band.line(4, row) + x);
      const Vec a1 = 2.0f * ma * mb + kSsimC1, a2 = 2.0f * (ab - ma * mb) + kSsimC2;
      const Vec b1 = ma * ma + mb * mb + kSsimC1, b2 = (aa - ma * ma) + (bb - mb * mb) + kSsimC2;
      const Vec inverse = 1.0f / (b1 * b2);
      const Vec s = a1 * a2 * inverse, s_b1 = s * inverse * b2, s_b2 = s * inverse * b1;
      ssim += share * s;
      store(partial[0] + place + x, share * 2.0f * (mb * (a2 - a1) * inverse + ma * (s_b2 - s_b1)));
      store(partial[1] + place + x, 0.0f - share * s_b2);
      store(partial[2] + place + x, share * 2.0f * a1 * inverse);
      const Vec difference = load_first(a + x, floats) - load_first(b + x, floats);
      l1 += share * max_vec(difference, 0.0f - difference);
    });
    sums[first + row] = {sum_of(ssim), sum_of(l1)};
  }
}

// Share times the sign of a - b, scaled, and what `along` says.
RF_INLINE Vec gradient_of(const Vec& share, const Vec& a, const Vec& b, float l1_scale, const Vec& along) {
  const Vec one = splat_vec(l1_scale);
  return share * select(a > b, one, select(a < b, 0.0f - one, Vec{})) + along;
}

template <int C>
void ssim_gradient_rows_of(const PicturePair& pair, int first, int rows, const float* const partial[3], float l1_scale,
                           float ssim_scale, float* gradient, float* scratch) {
  const LossBand band(pair, first, rows, scratch);
  band.clear_sides(3);
  for (int map = 0; map < 3; ++map) {
    const float* from[kSeenRows];
    band.seen(partial[map], band.stride, from);
    for (int x = 0; x < band.stride; x += kLanes) {
      Vec seen[kSeenRows];
      for (int at = 0; at < kSeenRows; ++at) seen[at] = load(from[at] + x);
      blur_columns(band, seen, map, x);
    }
  }
  if (pair.weight == nullptr) band.write_shares(first);
  for (int row = 0; row < rows; ++row) {
    if (pair.weight != nullptr) band.write_shares(first + row);
    const size_t place = static_cast<size_t>(first + row) * band.length;
    band.each_vector([&](int x, int floats) {
      const Vec a = load_first(pair.a + place + x, floats), b = load_first(pair.b + place + x, floats);
      const Vec of_a = blur_along<C>(pair, band.line(0, row) + x), of_aa = blur_along<C>(pair, band.line(1, row) + x);
      const Vec along = of_a + 2.0f * a * of_aa + b * blur_along<C>(pair, band.line(2, row) + x);
      const Vec result = gradient_of(load(band.shares + x), a, b, l1_scale, ssim_scale * along);
      store_first(gradient + place + x, result, floats);
    });
  }
}

void l1_rows(const PicturePair& pair, int first, int rows, float* const[3], LossSums* sums, float* scratch) {
  const LossBand band(pair, first, rows, scratch);
  for (int row = first; row < first + rows; ++row) {
    band.write_shares(row);
    const size_t place = static_cast<size_t>(row) * band.length;
    Vec l1 = {};
    band.each_vector([&](int x, int floats) {
      const Vec difference = load_first(pair.a + place + x, floats) - load_first(pair.b + place + x, floats);
      l1 += load(band.shares + x) * max_vec(difference, 0.0f - difference);
    });
    sums[row] = {0.0f, sum_of(l1)};
  }
}

void l1_gradient_rows(const PicturePair& pair, int first, int rows, const float* const[3], float l1_scale, float,
                      float* gradient, float* scratch) {
  const LossBand band(pair, first, rows, scratch);
  for (int row = first; row < first + rows; ++row) {
    band.write_shares(row);
    const size_t place = static_cast<size_t>(row) * band.length;
    band.each_vector([&](int x, int floats) {
      const Vec a = load_first(pair.a + place + x, floats), b = load_first(pair.b + place + x, floats);
      store_first(gradient + place + x, gradient_of(load(band.shares + x), a, b, l1_scale, Vec{}), floats);
    });
  }
}

void target_rows(const PicturePair& pair, int first, int rows, float* mean, float* square, float* scratch) {
  switch (pair.channels) {
    case 1: return target_rows_of<1>(pair, first, rows, mean, square, scratch);
    case 3: return target_rows_of<3>(pair, first, rows, mean, square, scratch);
    default: return target_rows_of<0>(pair, first, rows, mean, square, scratch);
  }
}

void ssim_rows(const PicturePair& pair, int first, int rows, float* const partial[3], LossSums* sums, float* scratch) {
  switch (pair.channels) {
    case 1: return ssim_rows_of<1>(pair, first, rows, partial, sums, scratch);
    case 3: return ssim_rows_of<3>(pair, first, rows, partial, sums, scratch);
    default: return ssim_rows_of<0>(pair, first, rows, partial, sums, scratch);
  }
}

void ssim_gradient_rows(const PicturePair& pair, int first, int rows, const float* const partial[3], float l1_scale,
                        float ssim_scale, float* gradient, float* scratch) {
  switch (pair.channels) {
    case 1: return ssim_gradient_rows_of<1>(pair, first, rows, partial, l1_scale, ssim_scale, gradient, scratch);
    case 3: return ssim_gradient_rows_of<3>(pair, first, rows, partial, l1_scale, ssim_scale, gradient, scratch);
    default: return ssim_gradient_rows_of<0>(pair, first, rows, partial, l1_scale, ssim_scale, gradient, scratch);
  }
}

}  // namespace
