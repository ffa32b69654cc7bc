// Gaussians as obstacles: how much of straight segments they let through.
//
// The Gaussians are sorted into leaves of sixteen neighbours and boxes around these into a tree of sixteen branches a
// node, so that both what blocks and where to look are answered for sixteen at a time. A segment visits its leaves in
// the order of the tree, so its product has one order, whatever else is asked and on how many threads.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "core/buffer.hpp"

namespace rf3dgs {

constexpr int kBranches = 16;
constexpr int kMostLevels = 8;
constexpr int kObstacleColumns = 13;  // mean 3, world to standard deviations 9 (row by row), opacity 1
constexpr int kBoxColumns = 6;        // low x, y, z and high x, y, z
constexpr float kObstacleCut = 5.0f;  // standard deviations that a box reaches
constexpr float kObstacleThinnest = 1e-6f;    // m: thinner Gaussians count as this thick
constexpr float kObstacleStop = 1e-4f;        // a segment may stop when less than this is left of it

// Leaves [leaf, kObstacleColumns, kBranches] and their labels [leaf, kBranches] (or null); boxes[0] [node, kBoxColumns,
// kBranches] are those of leaves, boxes[level] those of the nodes of the level below. The highest level has one node.
struct ObstacleTree {
  const float* leaves;
  const int32_t* labels;
  const float* boxes[kMostLevels];
  int levels;
};

// Segments [segment, 3] and the labels that do not block them (or null, or negative).
struct Segments {
  const float* start;
  const float* end;
  const int32_t* skip_start;
  const int32_t* skip_end;
  float stop_short;  // m, cut off at both ends
};

struct ObstacleKernels {
  // The share [segment] that passes of segments [begin, end).
  void (*transmittance)(const ObstacleTree&, const Segments&, size_t begin, size_t end, float* out);
};

const ObstacleKernels& portable_obstacles();
#if defined(RF3DGS_X86)
const ObstacleKernels& avx2_obstacles();
const ObstacleKernels& avx512_obstacles();
#endif

class Obstacles {
 public:
  // Gaussians that are not finite, or fainter than `min_opacity`, are left out. `labels` may be null.
  Obstacles(const float* means, const float* quats, const float* scales, const float* opacities, const int32_t* labels,
            size_t count, float min_opacity);

  // The share [segment] that passes, for segments [0, count).
  void transmittance(const Segments& segments, size_t count, int threads, float* out) const;

  size_t size() const { return size_; }
  bool has_labels() const { return tree_.labels != nullptr; }

 private:
  size_t size_ = 0;
  Buffer<float> leaves_;
  Buffer<int32_t> labels_;
  std::vector<Buffer<float>> boxes_;
  ObstacleTree tree_{};
};

}  // namespace rf3dgs
