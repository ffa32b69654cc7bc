#include "obstacles/obstacles.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>

#include "core/thread_pool.hpp"
#include "splats/kernels.hpp"

namespace rf3dgs {
namespace {

constexpr size_t kChunk = 64;  // segments that one index of the loop answers
constexpr float kInfinity = std::numeric_limits<float>::infinity();

const ObstacleKernels& obstacle_kernels() {
#if defined(RF3DGS_X86)
  const std::string name = kernels().name;
  if (name == "avx512") return avx512_obstacles();
  if (name == "avx2") return avx2_obstacles();
#endif
  return portable_obstacles();
}

struct Box {
  float low[3] = {kInfinity, kInfinity, kInfinity}, high[3] = {-kInfinity, -kInfinity, -kInfinity};

  void add(const Box& other) {
    for (int axis = 0; axis < 3; ++axis) {
      low[axis] = std::min(low[axis], other.low[axis]);
      high[axis] = std::max(high[axis], other.high[axis]);
    }
  }
};

// A Gaussian as it stands in a leaf, and the box of what it blocks.
struct Obstacle {
  float columns[kObstacleColumns];
  Box box;
  int32_t label;
};

bool is_sound(const float* mean, const float* quat, const float* scale, float opacity, float min_opacity) {
  float zero = 0.0f, norm2 = 0.0f;
  for (int at = 0; at < 3; ++at) zero += mean[at] * 0.0f + scale[at] * 0.0f;
  for (int at = 0; at < 4; ++at) norm2 += quat[at] * quat[at];
  return zero == 0.0f && norm2 > 1e-24f && norm2 < kInfinity && opacity >= min_opacity && opacity > 0.0f &&
         opacity < kInfinity && std::max({scale[0], scale[1], scale[2]}) >= 0.0f;
}

Obstacle obstacle_of(const float* mean, const float* quat, const float* scale, float opacity, int32_t label) {
  const float norm = std::sqrt(quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3]);
  const float w = quat[0] / norm, x = quat[1] / norm, y = quat[2] / norm, z = quat[3] / norm;
  const float axes[3][3] = {{1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)},
                            {2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)},
                            {2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)}};
  Obstacle result;
  float reach2[3] = {};
  for (int row = 0; row < 3; ++row) {
    const float width = std::max(scale[row], kObstacleThinnest);
    for (int col = 0; col < 3; ++col) {
      result.columns[3 + 3 * row + col] = axes[row][col] / width;
      reach2[col] += axes[row][col] * width * axes[row][col] * width;
    }
  }
  for (int axis = 0; axis < 3; ++axis) {
    result.columns[axis] = mean[axis];
    const float reach = kObstacleCut * std::sqrt(reach2[axis]);
    result.box.low[axis] = mean[axis] - reach;
    result.box.high[axis] = mean[axis] + reach;
  }
  result.columns[12] = std::min(opacity, 1.0f);
  result.label = label;
  return result;
}

// Halves Gaussians across the longest side of their means, again and again until sixteen are left, so that every run of
// 16^k from a multiple of 16^k on is one part of the halving.
void halve(const std::vector<Obstacle>& of, uint32_t* begin, uint32_t* end) {
  const size_t count = end - begin;
  if (count <= kBranches) return;
  size_t unit = kBranches;
  while (unit * kBranches < count) unit *= kBranches;
  uint32_t* const middle = begin + (count + unit - 1) / unit / 2 * unit;
  float low[3] = {kInfinity, kInfinity, kInfinity}, high[3] = {-kInfinity, -kInfinity, -kInfinity};
  for (const uint32_t* at = begin; at < end; ++at) {
    for (int axis = 0; axis < 3; ++axis) {
      low[axis] = std::min(low[axis], of[*at].columns[axis]);
      high[axis] = std::max(high[axis], of[*at].columns[axis]);
    }
  }
  int longest = 0;
  for (int axis = 1; axis < 3; ++axis) {
    if (high[axis] - low[axis] > high[longest] - low[longest]) longest = axis;
  }
  std::nth_element(begin, middle, end, [&](uint32_t a, uint32_t b) {
    const float left = of[a].columns[longest], right = of[b].columns[longest];
    return left != right ? left < right : a < b;
  });
  halve(of, begin, middle);
  halve(of, middle, end);
}

// The boxes of `count` things, sixteen a node.
void set_boxes(const std::vector<Box>& boxes, Buffer<float>& to) {
  const size_t nodes = (boxes.size() + kBranches - 1) / kBranches;
  float* const out = to.resize(nodes * kBoxColumns * kBranches);
  for (size_t at = 0; at < nodes * kBranches; ++at) {
    const Box box = at < boxes.size() ? boxes[at] : Box{};
    float* const node = out + at / kBranches * kBoxColumns * kBranches + at % kBranches;
    for (int axis = 0; axis < 3; ++axis) {
      node[axis * kBranches] = box.low[axis];
      node[(3 + axis) * kBranches] = box.high[axis];
    }
  }
}

std::vector<Box> boxes_of_sixteens(const std::vector<Box>& boxes) {
  std::vector<Box> result((boxes.size() + kBranches - 1) / kBranches);
  for (size_t at = 0; at < boxes.size(); ++at) result[at / kBranches].add(boxes[at]);
  return result;
}

}  // namespace

Obstacles::Obstacles(const float* means, const float* quats, const float* scales, const float* opacities,
                     const int32_t* labels, size_t count, float min_opacity) {
  std::vector<Obstacle> of;
  of.reserve(count);
  for (size_t at = 0; at < count; ++at) {
    if (!is_sound(means + 3 * at, quats + 4 * at, scales + 3 * at, opacities[at], min_opacity)) continue;
    of.push_back(obstacle_of(means + 3 * at, quats + 4 * at, scales + 3 * at, opacities[at],
                             labels == nullptr ? -1 : std::max(labels[at], -1)));
  }
  size_ = of.size();
  std::vector<uint32_t> order(size_);
  for (size_t at = 0; at < size_; ++at) order[at] = static_cast<uint32_t>(at);
  halve(of, order.data(), order.data() + size_);

  const size_t leaves = (size_ + kBranches - 1) / kBranches;
  float* const rows = leaves_.resize(leaves * kObstacleColumns * kBranches);
  int32_t* const names = labels_.resize(labels == nullptr ? 0 : leaves * kBranches);
  std::fill_n(rows, leaves * kObstacleColumns * kBranches, 0.0f);
  std::fill_n(names, labels_.size(), -1);
  std::vector<Box> boxes(size_);
  for (size_t at = 0; at < size_; ++at) {
    const Obstacle& obstacle = of[order[at]];
    float* const leaf = rows + at / kBranches * kObstacleColumns * kBranches + at % kBranches;
    for (int column = 0; column < kObstacleColumns; ++column) leaf[column * kBranches] = obstacle.columns[column];
    if (labels != nullptr) names[at] = obstacle.label;
    boxes[at] = obstacle.box;
  }
  tree_.leaves = rows;
  tree_.labels = labels == nullptr ? nullptr : names;
  boxes_.resize(kMostLevels);
  boxes = boxes_of_sixteens(boxes);
  while (!boxes.empty()) {
    set_boxes(boxes, boxes_[tree_.levels]);
    tree_.boxes[tree_.levels] = boxes_[tree_.levels].data();
    ++tree_.levels;
    if (boxes.size() <= kBranches) break;
    boxes = boxes_of_sixteens(boxes);
  }
}

void Obstacles::transmittance(const Segments& segments, size_t count, int threads, float* out) const {
  const int chunks = static_cast<int>((count + kChunk - 1) / kChunk);
  const ObstacleKernels& kernel = obstacle_kernels();
  parallel_for(chunks, threads, [&](int chunk) {
    const size_t begin = chunk * kChunk, end = std::min(count, begin + kChunk);
    kernel.transmittance(tree_, segments, begin, end, out);
  });
}

}  // namespace rf3dgs
