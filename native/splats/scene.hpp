// What the forward pass leaves for the backward pass, in memory that is recycled.
#pragma once

#include <vector>

#include "core/buffer.hpp"
#include "splats/kernels.hpp"

namespace rf3dgs {

// The Gaussians are cut into chunks of this many: the unit of work of everything that is done per Gaussian.
constexpr size_t kChunk = 2048;

struct SceneMemory {
  // Of the visible splats, in the order of the Gaussians.
  Buffer<float> splats;       // [visible, splat_floats]
  Buffer<uint32_t> sources;   // [visible] indices among the caller's Gaussians
  Buffer<float> values;       // [visible, channels]
  Buffer<uint32_t> slots;     // [visible + 1] first slot of each splat
  Buffer<size_t> chunk_start; // [chunk + 1] first visible splat of each chunk of Gaussians
  // Tile by tile, front to back.
  Buffer<Entry> entries;
  Buffer<size_t> tile_start;  // [tile + 1]

  // Of the passes themselves.
  Buffer<float> wide_splats;  // as projected, chunk by chunk with gaps
  Buffer<uint32_t> wide_sources;
  Buffer<Extent> wide_extents;
  std::vector<Buffer<Found>> found;  // [chunk]
  Buffer<size_t> tile_counts;        // [chunk, tile]
  Buffer<uint64_t> pairs;            // [chunk]
  Buffer<float> peaks;               // [slot]
  Buffer<float> rows;                // [slot, gradient_row]
  Buffer<float> values_gradient;     // [visible, channels]
  Buffer<float> ln_alpha_gradient;   // [visible]
  Buffer<float> geometry_sums;       // [visible, geometry sums]
};

struct Scene {
  View view;
  size_t gaussians = 0;
  int channels = 0;
  int tiles_x = 0, tiles_y = 0;
  float gate = 0.0f;
  size_t visible = 0;
  size_t entries = 0;  // splats in the lists of tiles
  size_t pairs = 0;    // splats in 4x4 blocks of pixels
  Recycled<SceneMemory> memory;

  const uint32_t* sources() const { return memory->sources.data(); }
  int chunks() const { return static_cast<int>((gaussians + kChunk - 1) / kChunk); }
  int tiles() const { return tiles_x * tiles_y; }
};

}  // namespace rf3dgs
