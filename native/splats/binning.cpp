#include "splats/binning.hpp"

#include <algorithm>
#include <bit>
#include <stdexcept>
#include <utility>

#include "core/thread_pool.hpp"

namespace rf3dgs {

void find_tiles(Scene& scene, int chunk) {
  SceneMemory& memory = *scene.memory;
  const ShapeKernels& shape = kernels().shape[static_cast<int>(scene.view.kind)];
  const size_t tiles = scene.tiles(), begin = chunk * kChunk, end = begin + memory.chunk_visible[chunk];
  uint32_t* const counts = memory.tile_counts.data() + chunk * tiles;
  uint32_t* const first_slot = memory.slots.data() + chunk * (kChunk + 1);
  std::fill_n(counts, tiles, 0u);
  Buffer<Found>& found = memory.found[chunk];
  size_t used = 0;
  first_slot[0] = 0;
  for (size_t at = begin; at < end; at += kReachGroup) {
    const int group = static_cast<int>(std::min<size_t>(kReachGroup, end - at));
    Found* const out = found.grow(used + group * tiles + 3, used) + used;
    uint32_t* const slots = first_slot + (at - begin) + 1;
    used += shape.tiles_reached(scene.view, memory.splats.data() + at * shape.splat_floats,
                                memory.extents.data() + at, group, static_cast<uint32_t>(at), slots, out);
    for (int splat = 0; splat < group; ++splat) slots[splat] += slots[splat - 1];
  }
  found.grow(used, used);
  for (size_t at = 0; at < used; ++at) ++counts[found[at].tile];
}

void list_tiles(Scene& scene, int threads) {
  SceneMemory& memory = *scene.memory;
  const int tiles = scene.tiles(), chunks = scene.chunks();
  size_t* const tile_start = memory.tile_start.resize(tiles + 1);
  size_t* const chunk_slot = memory.chunk_slot.resize(chunks + 1);
  chunk_slot[0] = 0;
  for (int chunk = 0; chunk < chunks; ++chunk) chunk_slot[chunk + 1] = chunk_slot[chunk] + memory.found[chunk].size();
  scene.entries = chunk_slot[chunks];
  if (scene.entries > UINT32_MAX) throw std::length_error("more than 2^32 pairs of a Gaussian and a tile");
  uint32_t total = 0;
  for (int tile = 0; tile < tiles; ++tile) {
    tile_start[tile] = total;
    for (int chunk = 0; chunk < chunks; ++chunk) {
      uint32_t& count = memory.tile_counts[static_cast<size_t>(chunk) * tiles + tile];
      total += std::exchange(count, total);
    }
  }
  tile_start[tiles] = total;
  memory.entries.resize(total);
  Entry* const unsorted = memory.unsorted.resize(total);
  parallel_for(chunks, threads, [&](int chunk) {
    uint32_t* const next = memory.tile_counts.data() + static_cast<size_t>(chunk) * tiles;
    uint32_t slot = static_cast<uint32_t>(chunk_slot[chunk]);
    const Buffer<Found>& found = memory.found[chunk];
    for (size_t at = 0; at < found.size(); ++at) {
      const Found& item = found[at];
      unsorted[next[item.tile]++] = {item.depth, item.splat, slot++, item.blocks};
    }
  });
}

// The bits of positive floats order as the floats do. The leading bits of the range that occurs go through two passes of
// counting, which keep the order of what is equal to them; insertion finishes what these leave nearly sorted.
void sort_by_depth(Scene& scene, int tile) {
  struct Item {
    uint32_t key, place;
  };
  SceneMemory& memory = *scene.memory;
  const size_t first = memory.tile_start[tile], count = memory.tile_start[tile + 1] - first;
  const Entry* const unsorted = memory.unsorted.data() + first;
  Entry* const entries = memory.entries.data() + first;
  thread_local Buffer<Item> buffers[2];
  Item *items = buffers[0].resize(count), *other = buffers[1].resize(count);
  const auto depth_bits = [&](size_t at) { return std::bit_cast<uint32_t>(unsorted[at].depth); };
  uint32_t low = UINT32_MAX, high = 0;
  for (size_t at = 0; at < count; ++at) {
    low = std::min(low, depth_bits(at));
    high = std::max(high, depth_bits(at));
  }
  const int bits = count < 2048 ? 7 : 10, buckets = 1 << bits;
  const int shift = std::max(0, static_cast<int>(std::bit_width(high - low)) - 2 * bits);
  thread_local uint32_t starts[2][1 << 10];
  for (auto& pass : starts) std::fill_n(pass, buckets, 0u);
  for (size_t at = 0; at < count; ++at) {
    const uint32_t key = (depth_bits(at) - low) >> shift;
    items[at] = {key, static_cast<uint32_t>(at)};
    ++starts[0][key & (buckets - 1)];
    ++starts[1][key >> bits];
  }
  for (int pass = 0; pass < 2; ++pass) {
    uint32_t sum = 0;
    for (int bucket = 0; bucket < buckets; ++bucket) sum += std::exchange(starts[pass][bucket], sum);
    for (size_t at = 0; at < count; ++at) {
      other[starts[pass][items[at].key >> (pass * bits) & (buckets - 1)]++] = items[at];
    }
    std::swap(items, other);
  }
  size_t patience = 8 * count;
  for (size_t at = 0; at < count; ++at) {
    const Entry entry = unsorted[items[at].place];
    size_t to = at;
    for (; to > 0 && entries[to - 1].depth > entry.depth && patience > 0; --to, --patience) entries[to] = entries[to - 1];
    entries[to] = entry;
  }
  if (patience == 0) {
    const auto nearer = [](const Entry& a, const Entry& b) {
      return a.depth < b.depth || (a.depth == b.depth && a.slot < b.slot);
    };
    std::sort(entries, entries + count, nearer);
  }
}

}  // namespace rf3dgs
