// Rows of a few floats of sixteen Gaussians, taken apart into columns and put together again.
#pragma once

#include "core/vector.hpp"

namespace {

#if defined(__AVX2__)

// Three or four floats; a fourth that is not there is not touched.
template <int Count>
RF_INLINE __m128 load_part(const float* from) {
  if constexpr (Count == 4) return _mm_loadu_ps(from);
  return _mm_maskload_ps(from, _mm_set_epi32(0, Count > 2 ? -1 : 0, Count > 1 ? -1 : 0, -1));
}

template <int Count>
RF_INLINE void store_part(float* to, __m128 value) {
  if constexpr (Count == 4) return _mm_storeu_ps(to, value);
  _mm_maskstore_ps(to, _mm_set_epi32(0, Count > 2 ? -1 : 0, Count > 1 ? -1 : 0, -1), value);
}

// Transposes the 4x4 matrices in every four lanes.
#define RF_TRANSPOSE(bits, a, b, c, d)                                                                          \
  do {                                                                                                          \
    const auto ab_low = _mm##bits##_unpacklo_ps(a, b), ab_high = _mm##bits##_unpackhi_ps(a, b);                 \
    const auto cd_low = _mm##bits##_unpacklo_ps(c, d), cd_high = _mm##bits##_unpackhi_ps(c, d);                 \
    a = _mm##bits##_shuffle_ps(ab_low, cd_low, 0x44), b = _mm##bits##_shuffle_ps(ab_low, cd_low, 0xee);         \
    c = _mm##bits##_shuffle_ps(ab_high, cd_high, 0x44), d = _mm##bits##_shuffle_ps(ab_high, cd_high, 0xee);     \
  } while (false)

#endif

#if defined(__AVX512F__)

template <int Count, class Row>
RF_INLINE void load_columns_part(const Row& row, int offset, Vec* out) {
  __m512 z[4];
  for (int i = 0; i < 4; ++i) {
    z[i] = _mm512_castps128_ps512(load_part<Count>(row(i) + offset));
    z[i] = _mm512_insertf32x4(z[i], load_part<Count>(row(4 + i) + offset), 1);
    z[i] = _mm512_insertf32x4(z[i], load_part<Count>(row(8 + i) + offset), 2);
    z[i] = _mm512_insertf32x4(z[i], load_part<Count>(row(12 + i) + offset), 3);
  }
  RF_TRANSPOSE(512, z[0], z[1], z[2], z[3]);
  for (int column = 0; column < Count; ++column) out[column] = (Vec)z[column];
}

template <int Count>
RF_INLINE void store_columns_part(const Vec* columns, float* const* rows, int lanes, int offset) {
  __m512 z[4];
  for (int i = 0; i < 4; ++i) z[i] = i < Count ? (__m512)columns[i] : _mm512_setzero_ps();
  RF_TRANSPOSE(512, z[0], z[1], z[2], z[3]);
  for (int i = 0; i < 4; ++i) {
    if (i < lanes) store_part<Count>(rows[i] + offset, _mm512_castps512_ps128(z[i]));
    if (4 + i < lanes) store_part<Count>(rows[4 + i] + offset, _mm512_extractf32x4_ps(z[i], 1));
    if (8 + i < lanes) store_part<Count>(rows[8 + i] + offset, _mm512_extractf32x4_ps(z[i], 2));
    if (12 + i < lanes) store_part<Count>(rows[12 + i] + offset, _mm512_extractf32x4_ps(z[i], 3));
  }
}

#elif defined(__AVX2__)

template <int Count, class Row>
RF_INLINE void load_columns_part(const Row& row, int offset, Vec* out) {
  for (int half = 0; half < 2; ++half) {
    __m256 y[4];
    for (int i = 0; i < 4; ++i) {
      y[i] = _mm256_insertf128_ps(_mm256_castps128_ps256(load_part<Count>(row(8 * half + i) + offset)),
                                  load_part<Count>(row(8 * half + 4 + i) + offset), 1);
    }
    RF_TRANSPOSE(256, y[0], y[1], y[2], y[3]);
    for (int column = 0; column < Count; ++column) out[column].part[half] = (FloatPart)y[column];
  }
}

template <int Count>
RF_INLINE void store_columns_part(const Vec* columns, float* const* rows, int lanes, int offset) {
  for (int half = 0; half < 2; ++half, rows += 8, lanes -= 8) {
    __m256 y[4];
    for (int i = 0; i < 4; ++i) y[i] = i < Count ? (__m256)columns[i].part[half] : _mm256_setzero_ps();
    RF_TRANSPOSE(256, y[0], y[1], y[2], y[3]);
    for (int i = 0; i < 4; ++i) {
      if (i < lanes) store_part<Count>(rows[i] + offset, _mm256_castps256_ps128(y[i]));
      if (4 + i < lanes) store_part<Count>(rows[4 + i] + offset, _mm256_extractf128_ps(y[i], 1));
    }
  }
}

#else

template <int Count, class Row>
RF_INLINE void load_columns_part(const Row& row, int offset, Vec* out) {
  for (int column = 0; column < Count; ++column) {
    alignas(64) float lanes[kLanes];
    for (int lane = 0; lane < kLanes; ++lane) lanes[lane] = row(lane)[offset + column];
    out[column] = load(lanes);
  }
}

template <int Count>
RF_INLINE void store_columns_part(const Vec* columns, float* const* rows, int lanes, int offset) {
  for (int column = 0; column < Count; ++column) {
    alignas(64) float of[kLanes];
    store(of, columns[column]);
    for (int lane = 0; lane < lanes; ++lane) rows[lane][offset + column] = of[lane];
  }
}

#endif

// The columns of sixteen rows of N floats, and back; row(lane) says where a row is.
template <int N, class Row>
RF_INLINE void load_columns(const Row& row, Vec* out) {
  for (int at = 0; at + 4 <= N; at += 4) load_columns_part<4>(row, at, out + at);
  if constexpr (N % 4 != 0) load_columns_part<N % 4>(row, N / 4 * 4, out + N / 4 * 4);
}

// Only the first `lanes` rows are written.
template <int N>
RF_INLINE void store_columns(const Vec* columns, float* const* rows, int lanes) {
  for (int at = 0; at + 4 <= N; at += 4) store_columns_part<4>(columns + at, rows, lanes, at);
  if constexpr (N % 4 != 0) store_columns_part<N % 4>(columns + N / 4 * 4, rows, lanes, N / 4 * 4);
}

// Sixteen rows of N floats that start at `from`; rows from `lanes` on repeat the last.
template <int N>
RF_INLINE void load_columns_from(const float* from, int lanes, Vec* out) {
  if (lanes == kLanes) {
    load_columns<N>([from](int lane) { return from + N * lane; }, out);
  } else {
    load_columns<N>([from, lanes](int lane) { return from + N * (lane < lanes ? lane : lanes - 1); }, out);
  }
}

// The same rows of N floats of an array, by their indices.
template <int N>
RF_INLINE void load_columns_at(const float* from, const uint32_t* index, int lanes, Vec* out) {
  load_columns<N>(
      [=](int lane) { return from + N * static_cast<size_t>(index[lane < lanes ? lane : lanes - 1]); }, out);
}

template <int N>
RF_INLINE void store_columns_to(const Vec* columns, float* to, int lanes) {
  float* rows[kLanes];
  for (int lane = 0; lane < kLanes; ++lane) rows[lane] = to + N * lane;
  store_columns<N>(columns, rows, lanes);
}

// Sixteen rows side by side, or those whose indices are given.
struct Neighbours {
  size_t start;
  int lanes;
  template <int N>
  RF_INLINE void columns(const float* from, Vec* out) const {
    load_columns_from<N>(from + N * start, lanes, out);
  }
};

struct Chosen {
  const uint32_t* sources;
  int lanes;
  template <int N>
  RF_INLINE void columns(const float* from, Vec* out) const {
    load_columns_at<N>(from, sources, lanes, out);
  }
};

}  // namespace
