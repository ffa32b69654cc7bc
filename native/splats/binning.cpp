#include "splats/binning.hpp"

#include <algorithm>
#include <bit>
#include <cstring>
#include <stdexcept>
#include <utility>

#include "core/thread_pool.hpp"

namespace rf3dgs {

void find_tiles(Scene& scene, int chunk, const Extent* extents) {
  SceneMemory& memory = *scene.memory;
  const ShapeKernels& shape = kernels().shape[static_cast<int>(scene.view.kind)];
  const size_t tiles = scene.tiles(), begin = memory.chunk_start[chunk], end = memory.chunk_start[chunk + 1];
  size_t* const counts = memory.tile_counts.data() + chunk * tiles;
  std::fill_n(counts, tiles, size_t{0});
  Buffer<Found>& found = memory.found[chunk];
  size_t used = 0;
  uint64_t pairs = 0;
  for (size_t at = begin; at < end; at += kReachGroup) {
    const int group = static_cast<int>(std::min<size_t>(kReachGroup, end - at));
    Found* const out = found.grow(used + group * tiles, used) + used;
    const size_t reached = shape.tiles_reached(scene.view, memory.splats.data() + at * shape.splat_floats,
                                               extents + (at - begin), group, static_cast<uint32_t>(at),
                                               memory.slots.data() + at + 1, out);
    for (const Found* item = out; item < out + reached; ++item) {
      ++counts[item->tile];
      pairs += std::popcount(item->blocks);
    }
    used += reached;
  }
  found.grow(used, used);
  memory.pairs[chunk] = pairs;
}

void list_tiles(Scene& scene, int threads) {
  SceneMemory& memory = *scene.memory;
  const int tiles = scene.tiles(), chunks = scene.chunks();
  size_t* const tile_start = memory.tile_start.resize(tiles + 1);
  size_t total = 0;
  for (int tile = 0; tile < tiles; ++tile) {
    tile_start[tile] = total;
    for (int chunk = 0; chunk < chunks; ++chunk) {
      size_t& count = memory.tile_counts[static_cast<size_t>(chunk) * tiles + tile];
      total += std::exchange(count, total);
    }
  }
  tile_start[tiles] = total;
  if (total > UINT32_MAX) throw std::length_error("more than 2^32 pairs of a Gaussian and a tile");
  uint32_t* const slots = memory.slots.data();
  slots[0] = 0;
  for (size_t at = 0; at < scene.visible; ++at) slots[at + 1] += slots[at];
  scene.entries = total;
  scene.pairs = 0;
  for (int chunk = 0; chunk < chunks; ++chunk) scene.pairs += memory.pairs[chunk];
  Entry* const entries = memory.entries.resize(total);
  parallel_for(chunks, threads, [&](int chunk) {
    size_t* const next = memory.tile_counts.data() + static_cast<size_t>(chunk) * tiles;
    uint32_t slot = slots[memory.chunk_start[chunk]];
    const Buffer<Found>& found = memory.found[chunk];
    for (size_t at = 0; at < found.size(); ++at) {
      const Found& item = found[at];
      entries[next[item.tile]++] = {item.depth, item.splat, slot++, item.blocks};
    }
  });
}

// Keys hold the depth, whose bits order as the depths do, above the place in the list. The sixteen leading bits of the
// range that occurs go through two passes of counting; what these leave nearly sorted is finished by insertion.
void sort_by_depth(Entry* entries, size_t count) {
  constexpr int kBits = 8, kBuckets = 1 << kBits;
  if (count < 2) return;
  thread_local Buffer<uint64_t> first, second;
  thread_local Buffer<Entry> copy;
  uint64_t *keys = first.resize(count), *other = second.resize(count);
  uint32_t low = UINT32_MAX, high = 0;
  for (size_t at = 0; at < count; ++at) {
    const uint32_t bits = std::bit_cast<uint32_t>(entries[at].depth);
    low = std::min(low, bits);
    high = std::max(high, bits);
    keys[at] = static_cast<uint64_t>(bits) << 32 | at;
  }
  if (count > 32) {
    const int shift = 32 + std::max(0, static_cast<int>(std::bit_width(high - low)) - 2 * kBits);
    const uint64_t base = static_cast<uint64_t>(low) << 32;
    uint32_t starts[2][kBuckets] = {};
    for (size_t at = 0; at < count; ++at) {
      const uint64_t lead = (keys[at] - base) >> shift;
      ++starts[0][lead & (kBuckets - 1)];
      ++starts[1][lead >> kBits];
    }
    for (auto& pass : starts) {
      uint32_t sum = 0;
      for (uint32_t& start : pass) sum += std::exchange(start, sum);
    }
    for (int pass = 0; pass < 2; ++pass) {
      for (size_t at = 0; at < count; ++at) {
        other[starts[pass][(keys[at] - base) >> (shift + pass * kBits) & (kBuckets - 1)]++] = keys[at];
      }
      std::swap(keys, other);
    }
  }
  size_t patience = 8 * count;
  for (size_t at = 1; at < count && patience > 0; ++at) {
    const uint64_t key = keys[at];
    size_t to = at;
    for (; to > 0 && keys[to - 1] > key && patience > 0; --to, --patience) keys[to] = keys[to - 1];
    keys[to] = key;
  }
  if (patience == 0) std::sort(keys, keys + count);
  Entry* const unsorted = copy.resize(count);
  std::copy_n(entries, count, unsorted);
  for (size_t at = 0; at < count; ++at) entries[at] = unsorted[keys[at] & UINT32_MAX];
}

}  // namespace rf3dgs
