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
constexpr size_t kAhead = 8;  // how early memory is asked for what is not read in order

int chunks_of(size_t count, size_t chunk) { return static_cast<int>((count + chunk - 1) / chunk); }

// The largest template the kernels have for what is left of the channels.
constexpr int kLargestChunk = 8;

int next_chunk(int left) {
  if (left >= kLargestChunk) return kLargestChunk;
  return left == 6 ? 3 : std::min(left, 5);
}

// Positions 0..n-1 ordered by depth, equal depths by position. Bits of positive floats order as the floats do.
std::vector<uint32_t> radix_order(const std::vector<Extent>& extents) {
  constexpr int kBits = 11, kBuckets = 1 << kBits;
  const size_t count = extents.size();
  struct Item {
    uint32_t key, position;
  };
  std::vector<Item> items(count), other(count);
  std::vector<uint32_t> histogram(3 * kBuckets, 0);
  for (size_t at = 0; at < count; ++at) {
    uint32_t key;
    std::memcpy(&key, &extents[at].depth, sizeof(key));
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

// Projects everything and keeps the visible splats with their values.
void project(Scene& scene, const Parameters& in, int threads, float* radii, std::vector<Extent>& extents) {
  const Kernels& kernel = kernels();
  const size_t count = scene.gaussians, channels = scene.channels;
  const int chunks = chunks_of(count, kProjectChunk);
  std::unique_ptr<Splat[]> splats(new Splat[count]);
  std::unique_ptr<Extent[]> boxes(new Extent[count]);
  std::vector<size_t> start(chunks + 1, 0);
  parallel_for(chunks, threads, [&](int chunk) {
    const size_t begin = chunk * kProjectChunk, end = std::min(count, begin + kProjectChunk);
    start[chunk + 1] = kernel.project(scene.view, in, begin, end, splats.get() + begin, boxes.get() + begin, radii);
  });
  std::partial_sum(start.begin(), start.end(), start.begin());
  scene.splats.resize(start.back());
  scene.values.resize(start.back() * channels);
  extents.resize(start.back());
  parallel_for(chunks, threads, [&](int chunk) {
    const size_t first = chunk * kProjectChunk, found = start[chunk + 1] - start[chunk];
    std::copy_n(splats.get() + first, found, scene.splats.data() + start[chunk]);
    std::copy_n(boxes.get() + first, found, extents.data() + start[chunk]);
    float* to = scene.values.data() + start[chunk] * channels;
    for (size_t at = first; at < first + found; ++at) {
      const float* from = in.values + splats[at].source * channels;
      for (size_t channel = 0; channel < channels; ++channel) *to++ = from[channel];
    }
  });
}

// Lists for every tile the splats that reach it, front to back.
void bin(Scene& scene, const std::vector<Extent>& extents, int threads) {
  const Kernels& kernel = kernels();
  const std::vector<uint32_t> order = radix_order(extents);
  const size_t visible = scene.splats.size();
  const int tiles = scene.tiles_x * scene.tiles_y;
  const int chunks = chunks_of(visible, kBinChunk);
  std::vector<std::vector<Found>> found(chunks);
  std::vector<size_t> counts(static_cast<size_t>(chunks) * tiles, 0);
  scene.place_start.assign(visible + 1, 0);
  const auto tile_of = [](float pixel, int limit) {
    return static_cast<int>(std::clamp(pixel / kTileSize, 0.0f, static_cast<float>(limit)));
  };
  parallel_for(chunks, threads, [&](int chunk) {
    const size_t begin = chunk * kBinChunk, end = std::min(visible, begin + kBinChunk);
    std::vector<Found> mine(3 * (end - begin));
    size_t* count = counts.data() + static_cast<size_t>(chunk) * tiles;
    size_t used = 0;
    for (size_t at = begin; at < end; ++at) {
      __builtin_prefetch(&scene.splats[order[std::min(at + kAhead, end - 1)]]);
      __builtin_prefetch(&extents[order[std::min(at + kAhead, end - 1)]]);
      const uint32_t index = order[at];
      const Splat& splat = scene.splats[index];
      const Extent& extent = extents[index];
      const TileBox box = {tile_of(splat.x - extent.x - 0.5f, scene.tiles_x - 1),
                           tile_of(splat.y - extent.y - 0.5f, scene.tiles_y - 1),
                           tile_of(splat.x + extent.x + 0.5f, scene.tiles_x - 1),
                           tile_of(splat.y + extent.y + 0.5f, scene.tiles_y - 1)};
      const size_t most = static_cast<size_t>(box.last_x - box.first_x + 1) * (box.last_y - box.first_y + 1);
      if (mine.size() < used + most) mine.resize(std::max(2 * mine.size(), used + most));
      const size_t reached = kernel.tiles_reached(splat, index, box, scene.tiles_x, mine.data() + used);
      for (const size_t stop = used + reached; used < stop; ++used) ++count[mine[used].tile];
      scene.place_start[index + 1] = reached;
    }
    mine.resize(used);
    found[chunk] = std::move(mine);
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
    uint32_t splat = UINT32_MAX;
    size_t place = 0;
    for (const Found& item : found[chunk]) {
      if (item.splat != splat) {
        splat = item.splat;
        place = scene.place_start[splat];
      }
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
    project(*scene, in, threads, radii, extents);
    bin(*scene, extents, threads);
  }
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
  std::vector<SplatGradient> of_splat(visible);
  const std::unique_ptr<float[]> rows(
      new float[scene.entries.size() * gradient_row(std::min(scene.channels, kLargestChunk), geometry)]);
  int chunk_width = 0;
  for (int first = 0; first < scene.channels; first += chunk_width) {
    chunk_width = next_chunk(scene.channels - first);
    const int width = gradient_row(chunk_width, geometry);
    parallel_for(scene.tiles_x * scene.tiles_y, threads, [&](int index) {
      Tile tile = tile_of(scene, index);
      tile.first = first;
      tile.chunk = chunk_width;
      kernel.blend_backward(tile, picture, weight, picture_gradient, weight_gradient, geometry,
                            rows.get() + scene.tile_start[index] * width);
    });
    parallel_for(chunks, threads, [&](int chunk) {
      const size_t begin = chunk * kReduceChunk, end = std::min(visible, begin + kReduceChunk);
      for (size_t at = begin; at < end; ++at) {
        float sums[kLargestChunk + 6] = {};
        for (size_t place = scene.place_start[at]; place < scene.place_start[at + 1]; ++place) {
          __builtin_prefetch(rows.get() + scene.places[std::min(place + kAhead, scene.places.size() - 1)] * width);
          const float* row = rows.get() + scene.places[place] * width;
          for (int column = 0; column < width; ++column) sums[column] += row[column];
        }
        if (out.values != nullptr) {
          float* to = out.values + static_cast<size_t>(scene.splats[at].source) * scene.channels + first;
          for (int channel = 0; channel < chunk_width; ++channel) to[channel] = sums[channel];
        }
        const float* of = sums + chunk_width;
        SplatGradient& sum = of_splat[at];
        sum.opacity += of[0];
        if (!geometry) continue;
        sum.x += of[1];
        sum.y += of[2];
        sum.a += of[3];
        sum.b += of[4];
        sum.c += of[5];
      }
    });
  }
  if (out.opacities == nullptr && !geometry) return;
  parallel_for(chunks, threads, [&](int chunk) {
    const size_t begin = chunk * kReduceChunk, end = std::min(visible, begin + kReduceChunk);
    for (size_t at = begin; at < end; ++at) {
      const size_t source = scene.splats[at].source;
      if (out.opacities != nullptr) out.opacities[source] = of_splat[at].opacity;
      if (out.offset != nullptr) {
        out.offset[2 * source] = of_splat[at].x;
        out.offset[2 * source + 1] = of_splat[at].y;
      }
    }
    if (through_projection) {
      kernel.project_backward(scene.view, in, scene.splats.data(), of_splat.data(), begin, end,
                              {out.means, out.quats, out.scales});
    }
  });
}

}  // namespace rf3dgs
