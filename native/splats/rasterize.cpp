#include "splats/rasterize.hpp"

#include <algorithm>
#include <bit>
#include <cstring>
#include <numeric>
#include <utility>

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

bool all_finite(const float* values, size_t count) {
  constexpr uint32_t kExponent = 0x7f800000u;
  uint32_t odd = 0;
  for (size_t at = 0; at < count; ++at) odd |= (std::bit_cast<uint32_t>(values[at]) & kExponent) == kExponent;
  return odd == 0;
}

// Projects a chunk of Gaussians, gets the values of what is visible, and finds the tiles it reaches.
void project_chunk(Scene& scene, const Geometry& geometry, const ValuesOf& values_of, int chunk, float* radii) {
  SceneMemory& memory = *scene.memory;
  const ShapeKernels& shape = shape_of(scene.view);
  const size_t begin = chunk * kChunk, last = std::min(scene.gaussians, begin + kChunk), channels = scene.channels;
  uint32_t* const sources = memory.sources.data() + begin;
  Extent* const extents = memory.extents.data() + begin;
  float* const values = memory.values.data() + begin * channels;
  const Projected out = {memory.splats.data() + begin * shape.splat_floats, sources, extents, radii};
  const size_t visible = shape.project(scene.view, geometry, scene.gaussians, begin, last, out);
  memory.chunk_visible[chunk] = static_cast<uint32_t>(visible);
  if (visible > 0) values_of(begin, begin + visible, sources, values);
  if (!all_finite(values, visible * channels)) {
    for (size_t at = 0; at < visible; ++at) {
      if (all_finite(values + at * channels, channels)) continue;
      std::fill_n(values + at * channels, channels, 0.0f);
      extents[at] = kNowhere;
      radii[sources[at]] = 0.0f;
    }
  }
  find_tiles(scene, chunk);
}

void project(Scene& scene, const Geometry& geometry, const ValuesOf& values_of, int threads, float* radii) {
  SceneMemory& memory = *scene.memory;
  const size_t chunks = scene.chunks();
  memory.chunk_visible.resize(chunks);
  memory.splats.resize(scene.gaussians * shape_of(scene.view).splat_floats);
  memory.sources.resize(scene.gaussians);
  memory.extents.resize(scene.gaussians);
  memory.values.resize(scene.gaussians * scene.channels);
  memory.slots.resize(chunks * (kChunk + 1));
  memory.unsorted.resize(scene.gaussians);
  memory.chunk_keys.resize(chunks);
  if (memory.found.size() < chunks) memory.found.resize(chunks);
  parallel_for(scene.chunks(), threads,
               [&](int chunk) { project_chunk(scene, geometry, values_of, chunk, radii); });
  scene.visible = std::accumulate(memory.chunk_visible.data(), memory.chunk_visible.data() + chunks, size_t{0});
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

// The slots of a visible splat, which is the index-th of its chunk.
std::pair<size_t, size_t> slots_of(const SceneMemory& memory, int chunk, size_t index) {
  const uint32_t* const first = memory.slots.data() + chunk * (kChunk + 1) + index;
  return {memory.chunk_slot[chunk] + first[0], memory.chunk_slot[chunk] + first[1]};
}

void keep_largest_weights(const Scene& scene, int threads, float* max_weight) {
  const SceneMemory& memory = *scene.memory;
  parallel_for(scene.chunks(), threads, [&](int chunk) {
    for (size_t index = 0; index < memory.chunk_visible[chunk]; ++index) {
      float& largest = max_weight[memory.sources[chunk * kChunk + index]];
      const auto [begin, end] = slots_of(memory, chunk, index);
      for (size_t slot = begin; slot < end; ++slot) largest = std::max(largest, memory.peaks[slot]);
    }
  });
}

// Adds up the rows of a chunk's splats: `width` channels of the values from `first` on, and the sums that belong to all
// channels together.
void reduce_rows(Scene& scene, int chunk, int first, int width, int geometry_sums) {
  typedef float Four __attribute__((vector_size(16)));
  constexpr int kMostFours = (kLargestChunk + 1 + kMostGeometrySums + 3) / 4;
  SceneMemory& memory = *scene.memory;
  const int row = gradient_row(width, geometry_sums), fours = row / 4;
  for (size_t index = 0; index < memory.chunk_visible[chunk]; ++index) {
    const size_t at = chunk * kChunk + index;
    const auto [begin, end] = slots_of(memory, chunk, index);
    Four total[kMostFours] = {};
    const float* from = memory.rows.data() + begin * row;
    for (size_t slot = begin; slot < end; ++slot) {
      for (int four = 0; four < fours; ++four, from += 4) {
        Four part;
        std::memcpy(&part, from, sizeof(part));
        total[four] += part;
      }
    }
    const float* sums = reinterpret_cast<const float*>(total);
    float* const values = memory.values_gradient.data() + at * scene.channels + first;
    for (int channel = 0; channel < width; ++channel) values[channel] = *sums++;
    float& ln_alpha = memory.ln_alpha_gradient[at];
    ln_alpha = *sums++ + (first == 0 ? 0.0f : ln_alpha);
    float* const geometry = memory.geometry_sums.data() + at * geometry_sums;
    for (int sum = 0; sum < geometry_sums; ++sum) geometry[sum] = *sums++ + (first == 0 ? 0.0f : geometry[sum]);
  }
}

// Gradients of a chunk's splats, from the sums to the caller.
void hand_over(const Scene& scene, const Geometry& geometry, int chunk, int geometry_sums, const TakeGradients& take) {
  thread_local Buffer<float> memory_of_rows, opacities;
  const SceneMemory& memory = *scene.memory;
  const size_t begin = chunk * kChunk, count = memory.chunk_visible[chunk], end = begin + count;
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
  if (view.kind == Kind::sphere) scene->view.sphere = sphere_grid(scene->memory->sphere, view.width, view.height);
  scene->gaussians = count;
  scene->channels = channels;
  scene->gate = gate;
  scene->tiles_x = (view.width + kTileSize - 1) / kTileSize;
  scene->tiles_y = (view.height + kTileSize - 1) / kTileSize;
  project(*scene, geometry, values_of, threads, radii);
  list_tiles(*scene, threads);
  SceneMemory& memory = *scene->memory;
  const ShapeKernels& shape = shape_of(view);
  const Blended out = {picture, weight, background,
                       max_weight == nullptr ? nullptr : memory.peaks.resize(scene->entries)};
  parallel_for(scene->tiles(), threads, [&](int index) {
    Tile tile = tile_of(*scene, index);
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
  memory.values_gradient.resize(scene.gaussians * scene.channels);
  memory.ln_alpha_gradient.resize(scene.gaussians);
  memory.geometry_sums.resize(scene.gaussians * geometry_sums);
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
