// Groups of sixteen Gaussians that a pinhole view cannot show, found before any of them is read.
//
// A Gaussian lies left of the picture where its centre does by more than its width on the screen, and no Gaussian is
// wider than  reach fx sqrt(1 + u^2) s / z + blur  for its largest scale s (see `may_be_seen`). Times the depth z,
//   fx x + (cx + blur) z + reach fx sqrt(1 + u_most^2) s < 0,
// which is linear in the centre: it holds for a whole ball of centres when it holds for its middle with the length of
// the normal times the radius added. The other three sides and the nearest depth are alike.
#pragma once

#include "core/vector.hpp"
#include "splats/constants.hpp"
#include "splats/kernels.hpp"

namespace {

using namespace rf3dgs;

constexpr float kReach2 = 11.09f;  // no Gaussian reaches further than sqrt(2 ln 255) standard deviations

// The columns of bounds of groups [begin, end). Gaussians that are never drawn, because a mean or a scale is not
// finite, count for nothing; a group without others has a radius that no side lets through.
void bound(const float* means, const float* scales, size_t gaussians, size_t begin, size_t end, float* bounds) {
  const size_t groups = bound_groups(gaussians);
  for (size_t group = begin; group < end; ++group) {
    const size_t first = group * kBoundGroup, last = first + kBoundGroup < gaussians ? first + kBoundGroup : gaussians;
    float low[3], high[3], largest = -1.0f;
    const auto each_fine = [&](auto work) {
      for (size_t at = first; at < last; ++at) {
        float sum = 0.0f;
        for (int axis = 0; axis < 3; ++axis) sum += means[3 * at + axis] * 0.0f + scales[3 * at + axis] * 0.0f;
        if (sum == 0.0f) work(means + 3 * at, scales + 3 * at);
      }
    };
    each_fine([&](const float* mean, const float* scale) {
      for (int axis = 0; axis < 3; ++axis) {
        low[axis] = largest < 0.0f ? mean[axis] : __builtin_fminf(low[axis], mean[axis]);
        high[axis] = largest < 0.0f ? mean[axis] : __builtin_fmaxf(high[axis], mean[axis]);
      }
      for (int axis = 0; axis < 3; ++axis) largest = __builtin_fmaxf(__builtin_fmaxf(largest, 0.0f), scale[axis]);
    });
    const bool some = largest >= 0.0f;
    float middle[3] = {}, radius2 = 0.0f;
    for (int axis = 0; axis < 3 && some; ++axis) middle[axis] = 0.5f * low[axis] + 0.5f * high[axis];
    each_fine([&](const float* mean, const float*) {
      float distance2 = 0.0f;
      for (int axis = 0; axis < 3; ++axis) distance2 += (mean[axis] - middle[axis]) * (mean[axis] - middle[axis]);
      radius2 = __builtin_fmaxf(radius2, distance2);
    });
    for (int axis = 0; axis < 3; ++axis) bounds[axis * groups + group] = middle[axis];
    bounds[3 * groups + group] = some ? 1.0001f * __builtin_sqrtf(radius2) : -__builtin_inff();
    bounds[4 * groups + group] = some ? largest : 0.0f;
  }
}

// A side of what the view sees, in the world: beyond it is a ball with normal . middle + shift + length radius +
// reach scale < 0.
struct Side {
  float normal[3], shift, length, reach;
};

RF_INLINE Side side_of(const View& view, float x, float y, float z, float shift, float reach) {
  Side side{{}, shift, __builtin_sqrtf(x * x + y * y + z * z), reach};
  const float of[3] = {x, y, z};
  for (int row = 0; row < 3; ++row) {
    side.shift += of[row] * view.translation[row];
    for (int axis = 0; axis < 3; ++axis) side.normal[axis] += of[row] * view.rotation[3 * row + axis];
  }
  return side;
}

struct Sides {
  Side side[5];

  RF_INLINE explicit Sides(const View& view) {
    const float reach = 1.01f * __builtin_sqrtf(kReach2), blur = __builtin_sqrtf(kReach2 * view.blur) + 1.0f;
    const float u = __builtin_fmaxf(__builtin_fabsf(view.u_low), __builtin_fabsf(view.u_high));
    const float v = __builtin_fmaxf(__builtin_fabsf(view.v_low), __builtin_fabsf(view.v_high));
    const float wide = reach * __builtin_fabsf(view.fx) * __builtin_sqrtf(1.0f + u * u);
    const float tall = reach * __builtin_fabsf(view.fy) * __builtin_sqrtf(1.0f + v * v);
    side[0] = side_of(view, view.fx, 0.0f, view.cx + blur, 0.0f, wide);
    side[1] = side_of(view, -view.fx, 0.0f, view.width + blur - view.cx, 0.0f, wide);
    side[2] = side_of(view, 0.0f, view.fy, view.cy + blur, 0.0f, tall);
    side[3] = side_of(view, 0.0f, -view.fy, view.height + blur - view.cy, 0.0f, tall);
    side[4] = side_of(view, 0.0f, 0.0f, 1.0f, -kNear, 0.0f);
  }

  // The bits of sixteen groups from `group` on of which a Gaussian may be seen. What rounding may cost is added.
  RF_INLINE uint32_t seen(const float* bounds, size_t groups, size_t group) const {
    constexpr float kRounding = 1e-5f;
    const Vec x = load(bounds + group), y = load(bounds + groups + group), z = load(bounds + 2 * groups + group);
    const Vec radius = load(bounds + 3 * groups + group), scale = load(bounds + 4 * groups + group);
    const Vec away = max_vec(x, 0.0f - x) + max_vec(y, 0.0f - y) + max_vec(z, 0.0f - z);
    uint32_t beyond = 0;
    for (const Side& of : side) {
      const Vec exact = of.normal[0] * x + of.normal[1] * y + of.normal[2] * z + of.length * radius + of.reach * scale;
      const Vec slack = kRounding * (of.length * away + (of.shift < 0.0f ? -of.shift : of.shift));
      beyond |= bits_of(exact + of.shift + slack < 0.0f);
    }
    return ~beyond & 0xffffu;
  }
};

}  // namespace
