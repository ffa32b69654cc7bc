// The splats are brought into the order of their depth once, all together; lists that are filled in this order need no
// sorting of their own. The bits of positive floats order as the floats do. As many of them as differ at all go through
// passes of counting, the lowest first, which keep the order of what is equal: equal depths stay in the order of the
// Gaussians. Work is cut into segments of a fixed number of splats, so the lists do not depend on the number of
// threads.
#include "splats/binning.hpp"

#include <algorithm>
#include <bit>
#include <stdexcept>
#include <utility>

#include "core/thread_pool.hpp"

namespace rf3dgs {
namespace {

constexpr size_t kSegment = 8192;  // splats
constexpr int kMostBits = 11;      // of a pass
constexpr size_t kAhead = 16;      // how early memory is asked for what is not read in order

int segments_of(size_t count) { return static_cast<int>((count + kSegment - 1) / kSegment); }

// Calls work(segment, first, last).
template <class SegmentWork>
void each_segment(size_t count, int threads, const SegmentWork& work) {
  const int segments = segments_of(count);
  parallel_for(segments, segments > 2 ? threads : 1, [&](int segment) {
    const size_t first = segment * kSegment;
    work(segment, first, std::min(count, first + kSegment));
  });
}

// From counts [segment, bucket] to where each segment's share of each bucket begins.
size_t starts_from_counts(uint32_t* counts, int segments, size_t buckets, size_t* bucket_start = nullptr) {
  uint32_t total = 0;
  for (size_t bucket = 0; bucket < buckets; ++bucket) {
    if (bucket_start != nullptr) bucket_start[bucket] = total;
    for (int segment = 0; segment < segments; ++segment) {
      total += std::exchange(counts[segment * buckets + bucket], total);
    }
  }
  return total;
}

// What the chunks found, side by side, and the keys of all splats that reach a tile, in the order of the Gaussians.
size_t gather(SceneMemory& memory, int chunks, int threads, DepthRange& range) {
  size_t* const first_key = memory.chunk_first_key.resize(chunks + 1);
  first_key[0] = 0;
  for (int chunk = 0; chunk < chunks; ++chunk) {
    const DepthRange& of = memory.chunk_keys[chunk];
    first_key[chunk + 1] = first_key[chunk] + of.count;
    range.low = std::min(range.low, of.low);
    range.high = std::max(range.high, of.high);
  }
  const size_t count = first_key[chunks], entries = memory.chunk_slot[chunks];
  DepthKey* const keys = memory.keys[0].resize(count);
  memory.keys[1].resize(count);
  Found* const all = memory.all_found.resize(entries + 1);
  all[entries].splat = UINT32_MAX;
  parallel_for(chunks, count > 2 * kSegment ? threads : 1, [&](int chunk) {
    const uint32_t slot = static_cast<uint32_t>(memory.chunk_slot[chunk]);
    std::copy_n(memory.found[chunk].data(), memory.found[chunk].size(), all + slot);
    const DepthKey* const from = memory.unsorted.data() + chunk * kChunk;
    DepthKey* const to = keys + first_key[chunk];
    for (size_t at = 0; at < memory.chunk_keys[chunk].count; ++at) to[at] = {from[at].depth_bits, from[at].slot + slot};
  });
  return count;
}

// Sorts the keys; returns those that are in order.
const DepthKey* sort_keys(SceneMemory& memory, size_t count, const DepthRange& range, int threads) {
  const int width = range.high > range.low ? std::bit_width(range.high - range.low) : 0;
  const int passes = (width + kMostBits - 1) / kMostBits;
  DepthKey *from = memory.keys[0].data(), *to = memory.keys[1].data();
  for (int pass = 0; pass < passes; ++pass) {
    const int bits = (width + passes - 1) / passes, shift = pass * bits;
    const size_t buckets = size_t{1} << bits;
    const auto bucket_of = [low = range.low, shift, last = static_cast<uint32_t>(buckets - 1)](const DepthKey& key) {
      return (key.depth_bits - low) >> shift & last;
    };
    uint32_t* const counts = memory.key_counts.resize(segments_of(count) * buckets);
    each_segment(count, threads, [&](int segment, size_t first, size_t last) {
      uint32_t* const mine = counts + segment * buckets;
      std::fill_n(mine, buckets, 0u);
      for (size_t at = first; at < last; ++at) ++mine[bucket_of(from[at])];
    });
    starts_from_counts(counts, segments_of(count), buckets);
    each_segment(count, threads, [&](int segment, size_t first, size_t last) {
      uint32_t* const mine = counts + segment * buckets;
      for (size_t at = first; at < last; ++at) to[mine[bucket_of(from[at])]++] = from[at];
    });
    std::swap(from, to);
  }
  return from;
}

// Calls work(found, slot) for every tile of the splats of sorted keys [first, last).
template <class FoundWork>
void each_found(const Found* found, const DepthKey* keys, size_t first, size_t last, const FoundWork& work) {
  for (size_t at = first; at < last; ++at) {
    __builtin_prefetch(found + keys[at + kAhead < last ? at + kAhead : at].slot);
    uint32_t slot = keys[at].slot;
    const uint32_t splat = found[slot].splat;
    do work(found[slot], slot);
    while (found[++slot].splat == splat);
  }
}

}  // namespace

void find_tiles(Scene& scene, int chunk) {
  SceneMemory& memory = *scene.memory;
  const ShapeKernels& shape = kernels().shape[static_cast<int>(scene.view.kind)];
  const size_t tiles = scene.tiles(), begin = chunk * kChunk, end = begin + memory.chunk_visible[chunk];
  uint32_t* const first_slot = memory.slots.data() + chunk * (kChunk + 1);
  DepthKey* key = memory.unsorted.data() + begin;
  DepthRange range;
  Buffer<Found>& found = memory.found[chunk];
  size_t used = 0;
  first_slot[0] = 0;
  for (size_t at = begin; at < end; at += kReachGroup) {
    const int group = static_cast<int>(std::min<size_t>(kReachGroup, end - at));
    Found* const out = found.grow(used + group * tiles + 3, used) + used;
    uint32_t* const slots = first_slot + (at - begin) + 1;
    used += shape.tiles_reached(scene.view, memory.splats.data() + at * shape.splat_floats,
                                memory.extents.data() + at, group, static_cast<uint32_t>(at), slots, out);
    for (int splat = 0; splat < group; ++splat) {
      const uint32_t first = slots[splat - 1];
      slots[splat] += first;
      if (slots[splat] == first) continue;
      const uint32_t bits = std::bit_cast<uint32_t>(found[first].depth);
      range.low = std::min(range.low, bits);
      range.high = std::max(range.high, bits);
      *key++ = {bits, first};
    }
  }
  found.grow(used, used);
  range.count = key - (memory.unsorted.data() + begin);
  memory.chunk_keys[chunk] = range;
}

void list_tiles(Scene& scene, int threads) {
  SceneMemory& memory = *scene.memory;
  const int chunks = scene.chunks();
  const size_t tiles = scene.tiles();
  size_t* const tile_start = memory.tile_start.resize(tiles + 1);
  size_t* const chunk_slot = memory.chunk_slot.resize(chunks + 1);
  chunk_slot[0] = 0;
  for (int chunk = 0; chunk < chunks; ++chunk) chunk_slot[chunk + 1] = chunk_slot[chunk] + memory.found[chunk].size();
  scene.entries = chunk_slot[chunks];
  if (scene.entries > UINT32_MAX) throw std::length_error("more than 2^32 pairs of a Gaussian and a tile");
  DepthRange range;
  const size_t count = gather(memory, chunks, threads, range);
  const Found* const all = memory.all_found.data();
  const DepthKey* const keys = sort_keys(memory, count, range, threads);
  uint32_t* const counts = memory.tile_counts.resize(std::max(1, segments_of(count)) * tiles);
  each_segment(count, threads, [&](int segment, size_t first, size_t last) {
    uint32_t* const mine = counts + segment * tiles;
    std::fill_n(mine, tiles, 0u);
    each_found(all, keys, first, last, [&](const Found& found, uint32_t) { ++mine[found.tile]; });
  });
  tile_start[tiles] = starts_from_counts(counts, segments_of(count), tiles, tile_start);
  Entry* const entries = memory.entries.resize(scene.entries);
  each_segment(count, threads, [&](int segment, size_t first, size_t last) {
    uint32_t* const next = counts + segment * tiles;
    each_found(all, keys, first, last, [&](const Found& found, uint32_t slot) {
      entries[next[found.tile]++] = {found.splat, slot, found.blocks};
    });
  });
}

}  // namespace rf3dgs
