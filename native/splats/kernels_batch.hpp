// A batch of a tile's list: its splats and values side by side, and the places of those that reach each 4x4 block.
#pragma once

#include "core/vector.hpp"
#include "splats/constants.hpp"
#include "splats/kernels.hpp"

namespace {

using namespace rf3dgs;

constexpr int kBlocks = 16;
constexpr int kBatch = 256;
constexpr float kColumns[kLanes] = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};
constexpr float kRows[kLanes] = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};

RF_INLINE int block_x(const Tile& tile, int block) { return tile.x + 4 * (block % 4); }
RF_INLINE int block_y(const Tile& tile, int block) { return tile.y + 4 * (block / 4); }

// The bits of the blocks that have pixels inside the picture.
RF_INLINE uint32_t blocks_inside(const Tile& tile) {
  uint32_t inside = 0;
  for (int block = 0; block < kBlocks; ++block) {
    if (block_x(tile, block) < tile.view->width && block_y(tile, block) < tile.view->height) inside |= 1u << block;
  }
  return inside;
}

#if defined(__AVX512F__)
// Three channels of four pixels a row are three fours of floats. With the rows' first, second and third fours in one
// vector each, a channel is a choice of lanes from two of them, four by four, and one more from the third; and back.
struct ThreeFours {
  __m512 four[3];

  static RF_INLINE __m512 rows(const float* from, size_t stride) {
    __m512 all = _mm512_castps128_ps512(_mm_loadu_ps(from));
    all = _mm512_insertf32x4(all, _mm_loadu_ps(from + stride), 1);
    all = _mm512_insertf32x4(all, _mm_loadu_ps(from + 2 * stride), 2);
    return _mm512_insertf32x4(all, _mm_loadu_ps(from + 3 * stride), 3);
  }
  RF_INLINE void load_channels(const float* from, size_t stride, Vec* out) {
    for (int at = 0; at < 3; ++at) four[at] = rows(from + 4 * at, stride);
    // r0 g0 b0 r1 | g1 b1 r2 g2 | b2 r3 g3 b3
    const __m512 a = four[0], b = four[1], c = four[2];
    const __m512 r23 = _mm512_shuffle_ps(b, c, _MM_SHUFFLE(1, 1, 2, 2));
    const __m512 b01 = _mm512_shuffle_ps(a, b, _MM_SHUFFLE(1, 1, 2, 2));
    const __m512 g01 = _mm512_shuffle_ps(a, b, _MM_SHUFFLE(0, 0, 1, 1));
    const __m512 g23 = _mm512_shuffle_ps(b, c, _MM_SHUFFLE(2, 2, 3, 3));
    out[0] = (Vec)_mm512_shuffle_ps(a, r23, _MM_SHUFFLE(2, 0, 3, 0));
    out[1] = (Vec)_mm512_shuffle_ps(g01, g23, _MM_SHUFFLE(2, 0, 2, 0));
    out[2] = (Vec)_mm512_shuffle_ps(b01, c, _MM_SHUFFLE(3, 0, 2, 0));
  }
};
#endif

// A block's share of a picture [row, col, channels]: the lanes of C channels from `first` on, zero beside the picture.
template <int C>
RF_INLINE void load_block(const Tile& tile, int block, const float* picture, int channels, int first, Vec* out) {
  const int x = block_x(tile, block), y = block_y(tile, block);
  const int cols = tile.view->width - x, rows = tile.view->height - y;
#if defined(__AVX512F__)
  if ((C == 1 || C == 3) && channels == C && cols >= 4 && rows >= 4) {
    const size_t stride = static_cast<size_t>(tile.view->width) * C;
    const float* from = picture + y * stride + static_cast<size_t>(x) * C;
    if constexpr (C == 3) return ThreeFours().load_channels(from, stride, out);
    out[0] = (Vec)ThreeFours::rows(from, stride);
    return;
  }
#endif
  alignas(64) float lanes[C][kLanes];
  if (cols < 4 || rows < 4) std::memset(lanes, 0, sizeof(lanes));
  for (int row = 0; row < 4 && row < rows; ++row) {
    const float* from = picture + (static_cast<size_t>(y + row) * tile.view->width + x) * channels + first;
    for (int col = 0; col < 4 && col < cols; ++col, from += channels) {
      for (int channel = 0; channel < C; ++channel) lanes[channel][4 * row + col] = from[channel];
    }
  }
  for (int channel = 0; channel < C; ++channel) out[channel] = load(lanes[channel]);
}

template <int C>
RF_INLINE void store_block(const Tile& tile, int block, const Vec* values, int channels, int first, float* picture) {
  alignas(64) float lanes[C][kLanes];
  for (int channel = 0; channel < C; ++channel) store(lanes[channel], values[channel]);
  const int x = block_x(tile, block), y = block_y(tile, block);
  const int cols = tile.view->width - x, rows = tile.view->height - y;
  for (int row = 0; row < 4 && row < rows; ++row) {
    float* to = picture + (static_cast<size_t>(y + row) * tile.view->width + x) * channels + first;
    for (int col = 0; col < 4 && col < cols; ++col, to += channels) {
      for (int channel = 0; channel < C; ++channel) to[channel] = lanes[channel][4 * row + col];
    }
  }
}

template <class Shape, int C>
struct Drawn {
  typename Shape::Splat splat;
  float value[C > 0 ? C : 1];
};

template <class Shape, int C>
struct Batch {
  int count;
  int listed[kBlocks];
  Drawn<Shape, C> drawn[kBatch];
  uint16_t list[kBlocks][kBatch + kLanes];

  // Entries from `begin` on, listed for the blocks of `wanted`.
  RF_INLINE void take(const Tile& tile, size_t begin, uint32_t wanted) {
    constexpr size_t kAhead = 12;  // how early memory is asked for what is not read in order
    alignas(64) uint32_t blocks[kBatch];
    const Entry* const entries = tile.entries + begin;
    count = static_cast<int>(tile.count - begin < kBatch ? tile.count - begin : kBatch);
    const auto* const splats = reinterpret_cast<const typename Shape::Splat*>(tile.splats);
    const float* const values = tile.values + tile.first;
    for (int at = 0; at < count; ++at) {
      const size_t ahead = entries[at + kAhead < static_cast<size_t>(count) ? at + kAhead : count - 1].splat;
      __builtin_prefetch(splats + ahead);
      __builtin_prefetch(values + ahead * tile.channels);
      const size_t splat = entries[at].splat;
      blocks[at] = entries[at].blocks;
      copy_splat(splats[splat], drawn[at].splat);
      for (int channel = 0; channel < C; ++channel) drawn[at].value[channel] = values[splat * tile.channels + channel];
    }
    std::memset(listed, 0, sizeof(listed));
    for (int at = 0; at < count; at += kLanes) {
      list_group(at, blocks + at, count - at < kLanes ? (1u << (count - at)) - 1 : 0xffff, wanted);
    }
  }

  static RF_INLINE void copy_splat(const typename Shape::Splat& from, typename Shape::Splat& to) {
    constexpr int kFloats = sizeof(from) / sizeof(float);
    static_assert(kFloats % 4 == 0, "a splat is copied four floats at a time");
    const float* const source = reinterpret_cast<const float*>(&from);
    float* const target = reinterpret_cast<float*>(&to);
    for (int at = 0; at < kFloats; at += 4) store_four(target + at, load_four(source + at));
  }

  // Sorts sixteen entries into the lists.
  RF_INLINE void list_group(int first, const uint32_t* blocks, uint32_t valid, uint32_t wanted) {
#if defined(__AVX512F__)
    const __m512i of = _mm512_maskz_loadu_epi32(static_cast<__mmask16>(valid), blocks);
    const __m512i places = _mm512_add_epi32(
        _mm512_set1_epi32(first), _mm512_set_epi32(15, 14, 13, 12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0));
    for (uint32_t left = wanted; left != 0; left &= left - 1) {
      const int block = __builtin_ctz(left);
      const __mmask16 reached = _mm512_test_epi32_mask(of, _mm512_set1_epi32(1 << block));
      const __m256i compact = _mm512_cvtepi32_epi16(_mm512_maskz_compress_epi32(reached, places));
      _mm256_storeu_si256(reinterpret_cast<__m256i*>(list[block] + listed[block]), compact);
      listed[block] += __builtin_popcount(reached);
    }
#else
    for (int at = 0; (valid >> at & 1) != 0; ++at) {
      for (uint32_t left = blocks[at] & wanted; left != 0; left &= left - 1) {
        const int block = __builtin_ctz(left);
        list[block][listed[block]++] = static_cast<uint16_t>(first + at);
      }
    }
#endif
  }
};

}  // namespace
