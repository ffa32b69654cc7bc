// Segments through a tree of Gaussians: sixteen boxes are tested at a time, and sixteen Gaussians.
#pragma once

#include "core/vector.hpp"
#include "obstacles/obstacles.hpp"

namespace {

using namespace rf3dgs;

RF_INLINE uint32_t bits_of_mask(const Mask& mask) {
#if defined(__AVX512F__)
  return mask;
#else
  return bits_of(mask);
#endif
}

// The product of all lanes, always multiplied in the same order.
RF_INLINE float product_of(const Vec& value) {
  typedef float Vec8 __attribute__((vector_size(32)));
  typedef float Vec4 __attribute__((vector_size(16)));
  Vec8 low, high;
  std::memcpy(&low, &value, 32);
  std::memcpy(&high, reinterpret_cast<const char*>(&value) + 32, 32);
  const Vec8 eight = low * high;
  Vec4 a, b;
  std::memcpy(&a, &eight, 16);
  std::memcpy(&b, reinterpret_cast<const char*>(&eight) + 16, 16);
  const Vec4 four = a * b;
  return (four[0] * four[2]) * (four[1] * four[3]);
}

// 1 / x for x whose reciprocal is a normal number.
RF_INLINE Vec inverse_of(const Vec& x) {
#if defined(__AVX512F__)
  const Vec guess = (Vec)_mm512_rcp14_ps((__m512)x);
  return mul_add(guess, mul_from(x, guess, splat_vec(1.0f)), guess);
#else
  return 1.0f / x;
#endif
}

// A segment: start + t along for t from `low` to `high` [m]. Where its box planes are met is t = plane inverse + shift;
// `near` and `far` say which of a box's planes is met first along each axis.
struct Ray {
  float start[3], along[3], inverse[3], shift[3];
  int near[3], far[3];
  float low, high;
  int32_t skip_start, skip_end;
};

enum class Kept { some, all, none };

// `none` passes of a segment that is not finite, `all` of one with nothing between its ends.
RF_INLINE Kept ray_of(const Segments& segments, size_t index, Ray& ray) {
  constexpr float kLeastSlope = 1e-12f;  // its inverse times a coordinate stays finite
  const float* const from = segments.start + 3 * index;
  const float* const to = segments.end + 3 * index;
  float length2 = 0.0f;
  for (int axis = 0; axis < 3; ++axis) {
    ray.start[axis] = from[axis];
    ray.along[axis] = to[axis] - from[axis];
    length2 += ray.along[axis] * ray.along[axis];
  }
  const float length = __builtin_sqrtf(length2);
  if (!(length < __builtin_inff())) return Kept::none;
  ray.low = segments.stop_short;
  ray.high = length - segments.stop_short;
  if (!(ray.high > ray.low)) return Kept::all;
  for (int axis = 0; axis < 3; ++axis) {
    const float slope = ray.along[axis] / (length > 1e-9f ? length : 1e-9f);
    ray.along[axis] = slope;
    const float size = __builtin_fabsf(slope) > kLeastSlope ? slope : __builtin_copysignf(kLeastSlope, slope);
    ray.inverse[axis] = 1.0f / size;
    ray.shift[axis] = -ray.start[axis] * ray.inverse[axis];
    const int low = axis * kBranches, high = (3 + axis) * kBranches;
    ray.near[axis] = size > 0.0f ? low : high;
    ray.far[axis] = size > 0.0f ? high : low;
  }
  constexpr int32_t kNobody = -2;  // leaves hold no label below -1
  const auto skip = [&](const int32_t* labels) {
    return labels == nullptr || labels[index] < 0 ? kNobody : labels[index];
  };
  ray.skip_start = skip(segments.skip_start);
  ray.skip_end = skip(segments.skip_end);
  return Kept::some;
}

// The bits of those of sixteen boxes that the segment meets.
RF_INLINE uint32_t boxes_met(const float* boxes, const Ray& ray) {
  Vec near = splat_vec(ray.low), far = splat_vec(ray.high);
  for (int axis = 0; axis < 3; ++axis) {
    const Vec inverse = splat_vec(ray.inverse[axis]), shift = splat_vec(ray.shift[axis]);
    near = max_vec(mul_add(load(boxes + ray.near[axis]), inverse, shift), near);
    far = min_vec(mul_add(load(boxes + ray.far[axis]), inverse, shift), far);
  }
  return bits_of_mask(at_least(far, near));
}

// What sixteen Gaussians let through, each for itself: 1 - o exp(-d^2 / 2) with the least Mahalanobis distance d.
template <bool kLabelled>
RF_INLINE Vec let_through(const float* leaf, const int32_t* labels, const Ray& ray) {
  constexpr float kHalfLog2E = 0.72134752f;
  Vec away[3];
  for (int axis = 0; axis < 3; ++axis) away[axis] = ray.start[axis] - load(leaf + axis * kBranches);
  Vec offset[3], step[3];
  for (int row = 0; row < 3; ++row) {
    const float* const inverse = leaf + (3 + 3 * row) * kBranches;
    const Vec x = load(inverse), y = load(inverse + kBranches), z = load(inverse + 2 * kBranches);
    offset[row] = mul_add(x, away[0], mul_add(y, away[1], z * away[2]));
    step[row] = mul_add(x, splat_vec(ray.along[0]), mul_add(y, splat_vec(ray.along[1]), z * ray.along[2]));
  }
  const Vec slope = mul_add(offset[0], step[0], mul_add(offset[1], step[1], offset[2] * step[2]));
  Vec square = mul_add(step[0], step[0], mul_add(step[1], step[1], step[2] * step[2]));
  square = max_vec(square, splat_vec(1e-30f));
  const Vec nearest = clamp_vec(-slope * inverse_of(square), splat_vec(ray.low), splat_vec(ray.high));
  Vec distance2 = splat_vec(0.0f);
  for (int row = 0; row < 3; ++row) {
    const Vec part = mul_add(nearest, step[row], offset[row]);
    distance2 = mul_add(part, part, distance2);
  }
  const Vec exponent = max_vec(distance2 * -kHalfLog2E, splat_vec(-100.0f));
  Vec opacity = load(leaf + 12 * kBranches);
  if constexpr (kLabelled) {
    IntVec names;
    std::memcpy(&names, labels, sizeof(names));
    opacity = select((names != ray.skip_start) & (names != ray.skip_end), opacity, splat_vec(0.0f));
  }
  return mul_from(opacity, exp2_vec(exponent), splat_vec(1.0f));
}

template <bool kLabelled>
RF_INLINE float passed(const ObstacleTree& tree, const Ray& ray) {
  constexpr size_t kNode = kBoxColumns * kBranches, kLeaf = kObstacleColumns * kBranches;
  size_t node[kMostLevels];
  uint32_t open[kMostLevels];
  Vec product = splat_vec(1.0f);
  int level = tree.levels - 1;
  node[level] = 0;
  open[level] = boxes_met(tree.boxes[level], ray);
  while (true) {
    if (open[level] == 0) {
      if (++level == tree.levels) break;
      if (level == 1 && product_of(product) < kObstacleStop) break;
      continue;
    }
    const size_t child = node[level] * kBranches + __builtin_ctz(open[level]);
    open[level] &= open[level] - 1;
    if (level > 0) {
      --level;
      node[level] = child;
      open[level] = boxes_met(tree.boxes[level] + child * kNode, ray);
    } else {
      product *= let_through<kLabelled>(tree.leaves + child * kLeaf,
                                        kLabelled ? tree.labels + child * kBranches : nullptr, ray);
    }
  }
  return product_of(product);
}

void transmittance(const ObstacleTree& tree, const Segments& segments, size_t begin, size_t end, float* out) {
  for (size_t index = begin; index < end; ++index) {
    Ray ray;
    const Kept kept = ray_of(segments, index, ray);
    if (kept != Kept::some || tree.levels == 0) {
      out[index] = kept == Kept::none ? 0.0f : 1.0f;
    } else if (tree.labels != nullptr && (ray.skip_start >= 0 || ray.skip_end >= 0)) {
      out[index] = passed<true>(tree, ray);
    } else {
      out[index] = passed<false>(tree, ray);
    }
  }
}

}  // namespace

#define RF3DGS_DEFINE_OBSTACLES(function)                        \
  namespace rf3dgs {                                             \
  const ObstacleKernels& function() {                            \
    static constexpr ObstacleKernels table = {::transmittance};  \
    return table;                                                \
  }                                                              \
  }
