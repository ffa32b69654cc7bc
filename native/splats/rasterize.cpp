#include "splats/rasterize.hpp"

#include <algorithm>
#include <cstring>
#include <numeric>
#include <utility>

#include "core/thread_pool.hpp"
#include "splats/constants.hpp"

namespace rf3dgs {
namespace {

constexpr size_t kProjectChunk = 2048;
constexpr size_t kBinChunk = 2048;
constexpr size_t kReduceChunk = 2048;

int chunks_of(size_t count, size_t chunk) { return static_cast<int>((count + chunk - 1) / chunk); }

// The largest template the kernels have for what is left of the channels.
int next_chunk(int left) {
  if (left >= 8) return 8;
  return left == 6 ? 3 : std::min(left, 5);
}

// Positions 0..n-1 ordered by key, equal keys by position. Bits of positive floats order as the floats do.
std::vector<uint32_t> radix_order(const std::vector<float>& depths) {
  constexpr int kBits = 11, kBuckets = 1 << kBits;
  const size_t count = depths.size();
  struct Item {
    uint32_t key, position;
  };
  std::vector<Item> items(count), other(count);
  std::vector<uint32_t> histogram(3 * kBuckets, 0);
  for (size_t at = 0; at < count; ++at) {
    uint32_t key;
    std::memcpy(&key, &depths[at], sizeof(key));
    items[at] = {key, static_cast<uint32_t>(at)};
    for (int pass = 0; pass < 3; ++pass) ++histogram[pass * kBuckets + (key >> (pass * kBits) & (kBuckets - 1))];
  }
  for (int pass = 0; pass < 3; ++pass) {
    uint32_t* starts = histogram.data() + pass * kBuckets;
    std::exclusive_scan(starts, starts + kBuckets, starts, 0u);
    for (const Item& item : items) other[starts[item.key >> (pass * kBits) & (kBuckets - 1)]++] = item;
    items.swap(other);
  }
  std::vector<uint32_t> order(count);
  for (size_t at = 0; at < count; ++at) order[at] = items[at].position;
  return order;
}

// Projects everything and keeps the visible splats in depth order.
void project_and_sort(Scene& scene, const Parameters& in, int threads, float* radii, std::vector<Extent>& extents) {
  const Kernels& kernel = kernels();
  const size_t count = scene.gaussians;
  const int chunks = chunks_of(count, kProjectChunk);
  std::unique_ptr<Splat[]> splats(new Splat[count]);
  std::unique_ptr<Extent[]> boxes(new Extent[count]);
  std::vector<size_t> start(chunks + 1, 0);
  parallel_for(chunks, threads, [&](int chunk) {
    const size_t begin = chunk * kProjectChunk, end = std::min(count, begin + kProjectChunk);
    start[chunk + 1] = kernel.project(scene.view, in, begin, end, splats.get() + begin, boxes.get() + begin, radii);
  });
  std::partial_sum(start.begin(), start.end(), start.begin());

  const size_t visible = start.back();
  std::vector<float> depths(visible);
  std::vector<uint32_t> source(visible);
  for (int chunk = 0; chunk < chunks; ++chunk) {
    for (size_t at = start[chunk]; at < start[chunk + 1]; ++at) {
      source[at] = static_cast<uint32_t>(chunk * kProjectChunk + (at - start[chunk]));
      depths[at] = boxes[source[at]].depth;
    }
  }
  const std::vector<uint32_t> order = radix_order(depths);
  scene.splats.resize(visible);
  extents.resize(visible);
  parallel_for(chunks_of(visible, kProjectChunk), threads, [&](int chunk) {
    const size_t begin = chunk * kProjectChunk, end = std::min(visible, begin + kProjectChunk);
    for (size_t at = begin; at < end; ++at) {
      scene.splats[at] = splats[source[order[at]]];
      extents[at] = boxes[source[order[at]]];
    }
  });
}

// Lists for every tile the splats that reach it, front to back.
void bin(Scene& scene, const std::vector<Extent>& extents, int threads) {
  const Kernels& kernel = kernels();
  const size_t visible = scene.splats.size();
  const int tiles = scene.tiles_x * scene.tiles_y;
  const int chunks = chunks_of(visible, kBinChunk);
  struct Found {
    uint32_t tile, splat, blocks;
  };
  std::vector<std::vector<Found>> found(chunks);
  std::vector<size_t> counts(static_cast<size_t>(chunks) * tiles, 0);
  scene.place_start.assign(visible + 1, 0);
  const auto tile_of = [](float pixel, int limit) {
    return static_cast<int>(std::clamp(pixel / kTileSize, 0.0f, static_cast<float>(limit)));
  };
  parallel_for(chunks, threads, [&](int chunk) {
    const size_t begin = chunk * kBinChunk, end = std::min(visible, begin + kBinChunk);
    std::vector<Found>& mine = found[chunk];
    size_t* count = counts.data() + static_cast<size_t>(chunk) * tiles;
    mine.reserve(2 * (end - begin));
    for (size_t at = begin; at < end; ++at) {
      const Splat& splat = scene.splats[at];
      const Extent& extent = extents[at];
      const int first_x = tile_of(splat.x - extent.x - 0.5f, scene.tiles_x - 1);
      const int first_y = tile_of(splat.y - extent.y - 0.5f, scene.tiles_y - 1);
      const int last_x = tile_of(splat.x + extent.x + 0.5f, scene.tiles_x - 1);
      const int last_y = tile_of(splat.y + extent.y + 0.5f, scene.tiles_y - 1);
      size_t reached = 0;
      for (int y = first_y; y <= last_y; ++y) {
        for (int x = first_x; x <= last_x; ++x) {
          const uint32_t blocks = kernel.blocks_reached(splat, x * kTileSize, y * kTileSize);
          if (blocks == 0) continue;
          const uint32_t tile = static_cast<uint32_t>(y * scene.tiles_x + x);
          mine.push_back({tile, static_cast<uint32_t>(at), blocks});
          ++count[tile];
          ++reached;
        }
      }
      scene.place_start[at + 1] = reached;
    }
  });
  scene.tile_start.assign(tiles + 1, 0);
  size_t total = 0;
  for (int tile = 0; tile < tiles; ++tile) {
    scene.tile_start[tile] = total;
    for (int chunk = 0; chunk < chunks; ++chunk) {
      size_t& count = counts[static_cast<size_t>(chunk) * tiles + tile];
      total += std::exchange(count, total);
    }
  }
  scene.tile_start[tiles] = total;
  std::partial_sum(scene.place_start.begin(), scene.place_start.end(), scene.place_start.begin());
  scene.entries.resize(total);
  scene.places.resize(total);
  parallel_for(chunks, threads, [&](int chunk) {
    size_t* next = counts.data() + static_cast<size_t>(chunk) * tiles;
    size_t place = scene.place_start[chunk * kBinChunk];
    for (const Found& item : found[chunk]) {
      const size_t to = next[item.tile]++;
      scene.entries[to] = {item.splat, item.blocks};
      scene.places[place++] = to;
    }
  });
}

Tile tile_of(const Scene& scene, int index) {
  Tile tile{};
  tile.x = index % scene.tiles_x * kTileSize;
  tile.y = index / scene.tiles_x * kTileSize;
  tile.entries = scene.entries.data() + scene.tile_start[index];
  tile.count = scene.tile_start[index + 1] - scene.tile_start[index];
  tile.splats = scene.splats.data();
  tile.values = scene.values.data();
  tile.channels = scene.channels;
  tile.width = scene.view.width;
  tile.height = scene.view.height;
  return tile;
}

}  // namespace

std::unique_ptr<Scene> rasterize(const View& view, size_t gaussians, const Parameters& in,
                                 const float* background, int threads, float* picture, float* weight, float* radii) {
  const int channels = in.channels;
  auto scene = std::make_unique<Scene>();
  scene->view = view;
  scene->gaussians = gaussians;
  scene->channels = channels;
  scene->tiles_x = (view.width + kTileSize - 1) / kTileSize;
  scene->tiles_y = (view.height + kTileSize - 1) / kTileSize;
  {
    std::vector<Extent> extents;
    project_and_sort(*scene, in, threads, radii, extents);
    bin(*scene, extents, threads);
  }
  const size_t visible = scene->splats.size();
  scene->values.resize(visible * channels);
  parallel_for(chunks_of(visible, kReduceChunk), threads, [&](int chunk) {
    const size_t begin = chunk * kReduceChunk, end = std::min(visible, begin + kReduceChunk);
    for (size_t at = begin; at < end; ++at) {
      std::copy_n(in.values + static_cast<size_t>(scene->splats[at].source) * channels, channels,
                  scene->values.data() + at * channels);
    }
  });
  const Kernels& kernel = kernels();
  parallel_for(scene->tiles_x * scene->tiles_y, threads, [&](int index) {
    Tile tile = tile_of(*scene, index);
    tile.background = background;
    for (; tile.first < channels; tile.first += tile.chunk) {
      tile.chunk = next_chunk(channels - tile.first);
      kernel.blend(tile, picture, weight);
    }
  });
  return scene;
}

void rasterize_backward(const Scene& scene, const Parameters& in, const float* picture, const float* weight,
                        const float* picture_gradient, const float* weight_gradient, int threads, const Gradients& out) {
  const Kernels& kernel = kernels();
  const size_t visible = scene.splats.size();
  const bool through_projection = out.means != nullptr;
  const bool geometry = through_projection || out.offset != nullptr;
  const int chunks = chunks_of(visible, kReduceChunk);
  std::vector<SplatGradient> of_entry(scene.entries.size(), SplatGradient{});
  std::vector<float> values_of_entry;
  int chunk_width = 0;
  for (int first = 0; first < scene.channels; first += chunk_width) {
    chunk_width = next_chunk(scene.channels - first);
    values_of_entry.assign(scene.entries.size() * chunk_width, 0.0f);
    parallel_for(scene.tiles_x * scene.tiles_y, threads, [&](int index) {
      Tile tile = tile_of(scene, index);
      tile.first = first;
      tile.chunk = chunk_width;
      const size_t start = scene.tile_start[index];
      kernel.blend_backward(tile, picture, weight, picture_gradient, weight_gradient, geometry,
                            values_of_entry.data() + start * chunk_width, of_entry.data() + start);
    });
    if (out.values == nullptr) continue;
    parallel_for(chunks, threads, [&](int chunk) {
      const size_t begin = chunk * kReduceChunk, end = std::min(visible, begin + kReduceChunk);
      for (size_t at = begin; at < end; ++at) {
        float* to = out.values + static_cast<size_t>(scene.splats[at].source) * scene.channels + first;
        for (size_t place = scene.place_start[at]; place < scene.place_start[at + 1]; ++place) {
          const float* from = values_of_entry.data() + scene.places[place] * chunk_width;
          for (int channel = 0; channel < chunk_width; ++channel) to[channel] += from[channel];
        }
      }
    });
  }
  if (out.opacities == nullptr && !geometry) return;
  std::vector<SplatGradient> of_splat(visible);
  parallel_for(chunks, threads, [&](int chunk) {
    const size_t begin = chunk * kReduceChunk, end = std::min(visible, begin + kReduceChunk);
    for (size_t at = begin; at < end; ++at) {
      SplatGradient sum{};
      for (size_t place = scene.place_start[at]; place < scene.place_start[at + 1]; ++place) {
        const SplatGradient& part = of_entry[scene.places[place]];
        sum.x += part.x;
        sum.y += part.y;
        sum.a += part.a;
        sum.b += part.b;
        sum.c += part.c;
        sum.opacity += part.opacity;
      }
      of_splat[at] = sum;
      const size_t source = scene.splats[at].source;
      if (out.opacities != nullptr) out.opacities[source] = sum.opacity;
      if (out.offset != nullptr) {
        out.offset[2 * source] = sum.x;
        out.offset[2 * source + 1] = sum.y;
      }
    }
    if (through_projection) {
      kernel.project_backward(scene.view, in, scene.splats.data(), of_splat.data(), begin, end,
                              {out.means, out.quats, out.scales});
    }
  });
}

}  // namespace rf3dgs
