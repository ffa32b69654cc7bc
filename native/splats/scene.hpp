// What the forward pass leaves for the backward pass, in memory that is recycled.
#pragma once

#include <bit>
#include <vector>

#include "core/buffer.hpp"
#include "splats/kernels.hpp"
#include "splats/sphere_grid.hpp"

namespace rf3dgs {

// The Gaussians are cut into chunks of this many: the unit of work of everything that is done per Gaussian.
constexpr size_t kChunk = 2048;

// The bits of a splat's depth, and the first of its slots: among those of its chunk, or of all.
struct DepthKey {
  uint32_t depth_bits, slot;
};
struct DepthRange {
  uint32_t low = UINT32_MAX, high = 0;  // bits of depths
  size_t count = 0;                     // of splats that reach a tile
};

// Places number the visible splats: chunk * kChunk for the first of a chunk, gaps behind the last. They keep the order of
// the Gaussians.
struct SceneMemory {
  SphereMemory sphere;
  Buffer<uint32_t> chunk_visible;  // [chunk] visible splats
  Buffer<float> splats;            // [place, splat_floats]
  Buffer<uint32_t> sources;        // [place] indices among the caller's Gaussians
  Buffer<Extent> extents;          // [place]
  Buffer<float> values;            // [place, channels]
  // Tile by tile, front to back.
  Buffer<Entry> entries;
  Buffer<size_t> tile_start;       // [tile + 1]
  // Where the gradients of entries go: chunk by chunk, splat by splat, tile by tile.
  Buffer<size_t> chunk_slot;       // [chunk + 1]
  Buffer<uint32_t> slots;          // [chunk, kChunk + 1] first slot of each splat after the chunk's first
  // Of the passes themselves.
  std::vector<Buffer<Found>> found;   // [chunk]
  Buffer<Found> all_found;            // [slot]
  Buffer<DepthKey> unsorted;          // [place] those of a chunk side by side
  Buffer<size_t> chunk_first_key;     // [chunk + 1]
  Buffer<DepthRange> chunk_keys;      // [chunk]
  Buffer<DepthKey> keys[2];           // of all chunks, before and after a pass of sorting
  Buffer<uint32_t> key_counts;        // [segment, bucket]
  Buffer<uint32_t> tile_counts;       // [segment, tile]
  Buffer<float> peaks;               // [slot]
  Buffer<float> rows;                // [slot, gradient_row]
  Buffer<float> values_gradient;     // [place, channels]
  Buffer<float> ln_alpha_gradient;   // [place]
  Buffer<float> geometry_sums;       // [place, geometry sums]
};

struct Scene {
  View view;
  size_t gaussians = 0;
  int channels = 0;
  int tiles_x = 0, tiles_y = 0;
  float gate = 0.0f;
  size_t visible = 0;
  size_t entries = 0;  // splats in the lists of tiles
  Recycled<SceneMemory> memory;

  int chunks() const { return static_cast<int>((gaussians + kChunk - 1) / kChunk); }
  int tiles() const { return tiles_x * tiles_y; }
  // How many splats reach a 4x4 block of pixels, over all blocks.
  size_t pairs() const {
    size_t sum = 0;
    for (size_t at = 0; at < entries; ++at) sum += std::popcount(memory->entries[at].blocks);
    return sum;
  }
};

}  // namespace rf3dgs
