// The shape of Gaussians in a pinhole picture (see kernels_blend.hpp): projected to the plane, drawn as ellipses.
#pragma once

#include <algorithm>

#include "core/vector.hpp"
#include "splats/constants.hpp"
#include "splats/kernels.hpp"
#include "splats/kernels_blend.hpp"
#include "splats/kernels_project.hpp"

namespace {

using namespace rf3dgs;

struct Pinhole {
  using Splat = PinholeSplat;

  struct Pixels {
    Vec x, y;  // centres
  };
  static RF_INLINE Pixels pixels(const View&, int x, int y) {
    return {load(kColumns) + (x + 0.5f), load(kRows) + (y + 0.5f)};
  }

  struct Point {
    Vec dx, dy;
  };
  static RF_INLINE Vec log2_alpha(const Splat& splat, const Pixels& pixels, Point& point) {
    point.dx = pixels.x - splat.x;
    point.dy = pixels.y - splat.y;
    const Vec u = splat.p * point.dx + splat.r * point.dy, v = splat.s * point.dy;
    return splat.peak - u * u - v * v;
  }

  // The sums of g d and of g d d^T.
  static constexpr int kGeometry = 5;
  static RF_INLINE void add_geometry(const Point& point, const Vec& g, Vec* sums) {
    const Vec gx = g * point.dx, gy = g * point.dy;
    sums[0] += gx;
    sums[1] += gy;
    sums[2] += gx * point.dx;
    sums[3] += gx * point.dy;
    sums[4] += gy * point.dy;
  }
};

// The least form (a, b; b, c) over each block's pixel centres' rectangle decides: a convex form's least value over a
// rectangle lies on an edge that faces the centre, or is zero inside.
size_t tiles_reached(const View& view, const float* splats, const Extent* extents, int count, uint32_t number,
                     uint32_t* reached, Found* out) {
  const int tiles_x = (view.width + kTileSize - 1) / kTileSize, tiles_y = (view.height + kTileSize - 1) / kTileSize;
  const auto tile_at = [](float pixel, int tiles) {
    return static_cast<int>(std::clamp(pixel / kTileSize, 0.0f, static_cast<float>(tiles - 1)));
  };
  size_t found = 0;
  for (int at = 0; at < count; ++at) {
    const PinholeSplat& splat = reinterpret_cast<const PinholeSplat*>(splats)[at];
    const Extent& extent = extents[at];
    reached[at] = 0;
    if (extent.right < extent.left) continue;
    const int first_x = tile_at(extent.left - 0.5f, tiles_x), last_x = tile_at(extent.right + 0.5f, tiles_x);
    const int first_y = tile_at(extent.top - 0.5f, tiles_y), last_y = tile_at(extent.bottom + 0.5f, tiles_y);
    const float a = splat.p * splat.p, b = splat.p * splat.r, c = splat.r * splat.r + splat.s * splat.s;
    const float slope_y = -b / c, slope_x = -b / a, cut = (splat.peak - kLog2AlphaMin) * 1.0001f + 1e-3f;
    const Vec lefts = 4.0f * load(kColumns) + (0.5f - splat.x), tops = 4.0f * load(kRows) + (0.5f - splat.y);
    const size_t before = found;
    for (int tile_y = first_y; tile_y <= last_y; ++tile_y) {
      const Vec top = tops + static_cast<float>(tile_y * kTileSize), bottom = top + 3.0f;
      const Vec near_y = clamp_vec(Vec{}, top, bottom);
      for (int tile_x = first_x; tile_x <= last_x; ++tile_x) {
        const Vec left = lefts + static_cast<float>(tile_x * kTileSize), right = left + 3.0f;
        const Vec near_x = clamp_vec(Vec{}, left, right);
        const Vec edge_y = clamp_vec(near_x * slope_y, top, bottom), edge_x = clamp_vec(near_y * slope_x, left, right);
        const Vec first = a * near_x * near_x + 2.0f * b * near_x * edge_y + c * edge_y * edge_y;
        const Vec second = a * edge_x * edge_x + 2.0f * b * edge_x * near_y + c * near_y * near_y;
        const uint32_t blocks = bits_of(min_vec(first, second) <= cut);
        out[found] = {static_cast<uint32_t>(tile_y * tiles_x + tile_x), number + at, blocks, splat.depth};
        found += blocks != 0;
      }
    }
    reached[at] = static_cast<uint32_t>(found - before);
  }
  return found;
}

constexpr ShapeKernels pinhole_kernels() {
  return {sizeof(PinholeSplat) / sizeof(float), Pinhole::kGeometry, project, project_backward, tiles_reached,
          blend<Pinhole>, blend_backward<Pinhole>};
}

}  // namespace
