#include "splats/rasterize.hpp"

#include <algorithm>
#include <bit>
#include <cmath>

#include "core/thread_pool.hpp"
#include "splats/binning.hpp"
#include "splats/constants.hpp"

namespace rf3dgs {
namespace {

// The largest template the kernels have for what is left of the channels.
constexpr int kLargestChunk = 8;

int next_chunk(int left) {
  if (left >= kLargestChunk) return kLargestChunk;
  return left == 6 ? 3 : std::min(left, 5);
}

const ShapeKernels& shape_of(const View& view) { return kernels().shape[static_cast<int>(view.kind)]; }

bool all_finite(const float* values, int count) {
  bool fine = true;
  for (int at = 0; at < count; ++at) fine &= (std::bit_cast<uint32_t>(values[at]) & 0x7f800000u) != 0x7f800000u;
  return fine;
}

// Projects everything; the visible splats of a chunk lie at the chunk's place, gaps follow.
void project(Scene& scene, const Geometry& geometry, int threads, float* radii) {
  SceneMemory& memory = *scene.memory;
  const ShapeKernels& shape = shape_of(scene.view);
  float* const splats = memory.wide_splats.resize(scene.gaussians * shape.splat_floats);
  uint32_t* const sources = memory.wide_sources.resize(scene.gaussians);
  Extent* const extents = memory.wide_extents.resize(scene.gaussians);
  size_t* const start = memory.chunk_start.resize(scene.chunks() + 1);
  start[0] = 0;
  parallel_for(scene.chunks(), threads, [&](int chunk) {
    const size_t begin = chunk * kChunk, end = std::min(scene.gaussians, begin + kChunk);
    const Projected out = {splats + begin * shape.splat_floats, sources + begin, extents + begin, radii};
    start[chunk + 1] = shape.project(scene.view, geometry, begin, end, out);
  });
  for (int chunk = 0; chunk < scene.chunks(); ++chunk) start[chunk + 1] += start[chunk];
  scene.visible = start[scene.chunks()];
}

// Moves the visible splats together, gets their values and finds the tiles they reach.
void gather_visible(Scene& scene, const ValuesOf& values_of, int threads, float* radii) {
  SceneMemory& memory = *scene.memory;
  const size_t width = shape_of(scene.view).splat_floats, channels = scene.channels;
  float* const splats = memory.splats.resize(scene.visible * width);
  uint32_t* const sources = memory.sources.resize(scene.visible);
  float* const values = memory.values.resize(scene.visible * channels);
  memory.slots.resize(scene.visible + 1);
  memory.tile_counts.resize(static_cast<size_t>(scene.chunks()) * scene.tiles());
  memory.pairs.resize(scene.chunks());
  if (memory.found.size() < static_cast<size_t>(scene.chunks())) memory.found.resize(scene.chunks());
  parallel_for(scene.chunks(), threads, [&](int chunk) {
    const size_t from = chunk * kChunk, begin = memory.chunk_start[chunk], end = memory.chunk_start[chunk + 1];
    std::copy_n(memory.wide_splats.data() + from * width, (end - begin) * width, splats + begin * width);
    std::copy_n(memory.wide_sources.data() + from, end - begin, sources + begin);
    if (begin < end) values_of(begin, end, sources + begin, values + begin * channels);
    Extent* const extents = memory.wide_extents.data() + from;
    for (size_t at = begin; at < end; ++at) {
      if (all_finite(values + at * channels, scene.channels)) continue;
      std::fill_n(values + at * channels, channels, 0.0f);
      extents[at - begin] = kNowhere;
      radii[sources[at]] = 0.0f;
    }
    find_tiles(scene, chunk, extents);
  });
}

Tile tile_of(const Scene& scene, int index) {
  const SceneMemory& memory = *scene.memory;
  Tile tile{};
  tile.view = &scene.view;
  tile.x = index % scene.tiles_x * kTileSize;
  tile.y = index / scene.tiles_x * kTileSize;
  tile.entries = memory.entries.data() + memory.tile_start[index];
  tile.count = memory.tile_start[index + 1] - memory.tile_start[index];
  tile.splats = memory.splats.data();
  tile.values = memory.values.data();
  tile.channels = scene.channels;
  tile.gate = scene.gate;
  return tile;
}

void keep_largest_weights(const Scene& scene, int threads, float* max_weight) {
  const SceneMemory& memory = *scene.memory;
  parallel_for(scene.chunks(), threads, [&](int chunk) {
    for (size_t at = memory.chunk_start[chunk]; at < memory.chunk_start[chunk + 1]; ++at) {
      float& largest = max_weight[memory.sources[at]];
      for (uint32_t slot = memory.slots[at]; slot < memory.slots[at + 1]; ++slot) {
        largest = std::max(largest, memory.peaks[slot]);
      }
    }
  });
}

// Adds up the rows of a chunk's splats: `width` channels of the values from `first` on, and the sums that belong to all
// channels together.
void reduce_rows(Scene& scene, int chunk, int first, int width, int geometry_sums) {
  constexpr int kMost = kLargestChunk + 16;
  SceneMemory& memory = *scene.memory;
  const int row = gradient_row(width, geometry_sums);
  for (size_t at = memory.chunk_start[chunk]; at < memory.chunk_start[chunk + 1]; ++at) {
    float total[kMost] = {};
    for (uint32_t slot = memory.slots[at]; slot < memory.slots[at + 1]; ++slot) {
      const float* from = memory.rows.data() + static_cast<size_t>(slot) * row;
      for (int column = 0; column < row; ++column) total[column] += from[column];
    }
    std::copy_n(total, width, memory.values_gradient.data() + at * scene.channels + first);
    float& ln_alpha = memory.ln_alpha_gradient[at];
    float* const geometry = memory.geometry_sums.data() + at * geometry_sums;
    ln_alpha = total[width] + (first == 0 ? 0.0f : ln_alpha);
    for (int sum = 0; sum < geometry_sums; ++sum) {
      geometry[sum] = total[width + 1 + sum] + (first == 0 ? 0.0f : geometry[sum]);
    }
  }
}

// Gradients of a chunk's splats, from the sums to the caller.
void hand_over(const Scene& scene, const Geometry& geometry, int chunk, int geometry_sums, const TakeGradients& take) {
  thread_local Buffer<float> memory_of_rows, opacities;
  const SceneMemory& memory = *scene.memory;
  const size_t begin = memory.chunk_start[chunk], end = memory.chunk_start[chunk + 1], count = end - begin;
  if (count == 0) return;
  const uint32_t* const sources = memory.sources.data() + begin;
  const float* const values = memory.values_gradient.data() + begin * scene.channels;
  float* const opacity = opacities.resize(count);
  for (size_t at = 0; at < count; ++at) {
    opacity[at] = memory.ln_alpha_gradient[begin + at] / geometry.opacities[sources[at]];
  }
  if (geometry_sums == 0) return take(begin, end, sources, values, opacity, nullptr);
  const float* const sums = memory.geometry_sums.data() + begin * geometry_sums;
  GeometryRows rows{};
  if (scene.view.kind == Kind::sphere) {
    rows.sphere = memory_of_rows.resize(9 * count);
  } else {
    rows.means = memory_of_rows.resize(12 * count);
    rows.scales = rows.means + 3 * count;
    rows.quats = rows.scales + 3 * count;
    rows.offset = rows.quats + 4 * count;
  }
  shape_of(scene.view).project_backward(scene.view, geometry, sources, sums, count, rows);
  take(begin, end, sources, values, opacity, &rows);
}

}  // namespace

std::unique_ptr<Scene> rasterize(const View& view, size_t count, const Geometry& geometry, int channels,
                                 const ValuesOf& values_of, const float* background, float gate, int threads,
                                 float* picture, float* weight, float* radii, float* max_weight) {
  auto scene = std::make_unique<Scene>();
  scene->view = view;
  scene->gaussians = count;
  scene->channels = channels;
  scene->gate = gate;
  scene->tiles_x = (view.width + kTileSize - 1) / kTileSize;
  scene->tiles_y = (view.height + kTileSize - 1) / kTileSize;
  project(*scene, geometry, threads, radii);
  gather_visible(*scene, values_of, threads, radii);
  list_tiles(*scene, threads);
  SceneMemory& memory = *scene->memory;
  const ShapeKernels& shape = shape_of(view);
  const Blended out = {picture, weight, background,
                       max_weight == nullptr ? nullptr : memory.peaks.resize(scene->entries)};
  parallel_for(scene->tiles(), threads, [&](int index) {
    Tile tile = tile_of(*scene, index);
    sort_by_depth(memory.entries.data() + memory.tile_start[index], tile.count);
    for (; tile.first < channels; tile.first += tile.chunk) {
      tile.chunk = next_chunk(channels - tile.first);
      shape.blend(tile, out);
    }
  });
  if (max_weight != nullptr) keep_largest_weights(*scene, threads, max_weight);
  return scene;
}

void rasterize_backward(Scene& scene, const Geometry& geometry, const float* picture, const float* weight,
                        const float* picture_gradient, const float* weight_gradient, Which which, int threads,
                        const TakeGradients& take) {
  SceneMemory& memory = *scene.memory;
  const ShapeKernels& shape = shape_of(scene.view);
  const int geometry_sums = which == Which::everything ? shape.geometry_sums : 0;
  memory.values_gradient.resize(scene.visible * scene.channels);
  memory.ln_alpha_gradient.resize(scene.visible);
  memory.geometry_sums.resize(scene.visible * geometry_sums);
  int width = 0;
  for (int first = 0; first < scene.channels; first += width) {
    width = next_chunk(scene.channels - first);
    float* const rows = memory.rows.resize(scene.entries * gradient_row(width, geometry_sums));
    const Slopes slopes = {picture, weight, picture_gradient, weight_gradient, geometry_sums > 0, rows};
    parallel_for(scene.tiles(), threads, [&](int index) {
      Tile tile = tile_of(scene, index);
      tile.first = first;
      tile.chunk = width;
      shape.blend_backward(tile, slopes);
    });
    const bool last = first + width == scene.channels;
    parallel_for(scene.chunks(), threads, [&](int chunk) {
      reduce_rows(scene, chunk, first, width, geometry_sums);
      if (last) hand_over(scene, geometry, chunk, geometry_sums, take);
    });
  }
}

}  // namespace rf3dgs
