// The shape of Gaussians on the whole sphere (see kernels_blend.hpp): each is drawn in the plane that touches the unit
// sphere in its own direction, so there is no seam, no pole and no edge of a field. The letters are those of
// kernels_sphere_project.hpp.
#pragma once

#include <algorithm>

#include "core/vector.hpp"
#include "splats/constants.hpp"
#include "splats/kernels.hpp"
#include "splats/kernels_blend.hpp"
#include "splats/kernels_sphere_project.hpp"

namespace {

using namespace rf3dgs;

struct Sphere {
  using Splat = SphereSplat;

  struct Pixels {
    Vec x, y, z;  // directions
  };
  static RF_INLINE Pixels pixels(const View& view, int x, int y) {
    const float* const column = view.sphere.block_column + x / 4 * 2 * kLanes;
    const float* const row = view.sphere.block_row + y / 4 * 2 * kLanes;
    const Vec sine = -load(row);
    return {sine * load(column), -load(row + kLanes), sine * load(column + kLanes)};
  }

  struct Point {
    Vec u, v;
  };
  static RF_INLINE Vec log2_alpha(const Splat& splat, const Pixels& d, Point& point) {
    const auto along = [&](const float* f) {
      return mul_add(splat_vec(f[0]), d.x, mul_add(splat_vec(f[1]), d.y, f[2] * d.z));
    };
    const Vec field = splat_vec(kSphereField), cosine = along(splat.m), inverse = reciprocal(max_vec(cosine, field));
    point.u = along(splat.f1) * inverse;
    point.v = along(splat.f2) * inverse;
    const Vec exponent = mul_from(point.v, point.v, mul_from(point.u, point.u, splat_vec(splat.peak)));
    return choose(below(field, cosine), exponent, splat_vec(-125.0f));
  }

  // g u, g u u^T and g |u|^2 u.
  static constexpr int kGeometry = 7;
  static RF_INLINE void geometry_parts(const Point& point, const Vec& g, Vec* parts) {
    const Vec gu = g * point.u, gv = g * point.v, squared = point.u * point.u + point.v * point.v;
    parts[0] = gu;
    parts[1] = gv;
    parts[2] = gu * point.u;
    parts[3] = gu * point.v;
    parts[4] = gv * point.v;
    parts[5] = gu * squared;
    parts[6] = gv * squared;
  }
};

// The sixteen blocks of a tile against one splat. A block's pixels lie around u0 at its middle, at most `across` along the
// columns and `down` along the rows to either side; seen along u0 none is nearer than |u0| - |across.u0| / |u0| -
// |down.u0| / |u0|. With a = d.f, c = d.m and u0 = a / c this is multiplied by c^3 |u0|, so nothing is divided.
RF_INLINE uint32_t blocks_reached(const View& view, const SphereSplat& splat, int tile_x, int tile_y) {
  const float turn = 1.5f * 2 * kPi / view.width, tilt = 1.5f * kPi / view.height;
  const float field = kSphereField - __builtin_sqrtf(turn * turn + tilt * tilt);
  const Vec sine_t = load(view.sphere.tile_column + 2 * kLanes * tile_x);
  const Vec cosine_t = load(view.sphere.tile_column + 2 * kLanes * tile_x + kLanes);
  const Vec sine = load(view.sphere.tile_row + 2 * kLanes * tile_y);
  const Vec cosine = load(view.sphere.tile_row + 2 * kLanes * tile_y + kLanes);
  Vec value[3], across[3], down[3];
  const float* const of[3] = {splat.f1, splat.f2, splat.m};
  for (int at = 0; at < 3; ++at) {
    const Vec level = -(of[at][0] * sine_t + of[at][2] * cosine_t);
    value[at] = sine * level - of[at][1] * cosine;
    across[at] = of[at][2] * sine_t - of[at][0] * cosine_t;
    down[at] = cosine * level + of[at][1] * sine;
  }
  const Vec c = value[2], squared = value[0] * value[0] + value[1] * value[1];
  const Vec along = turn * sine * (c * (value[0] * across[0] + value[1] * across[1]) - squared * across[2]);
  const Vec below = tilt * (c * (value[0] * down[0] + value[1] * down[1]) - squared * down[2]);
  const Vec nearest = c * squared - abs_vec(along) - abs_vec(below), cc = c * c;
  const uint32_t reached = bits_of(nearest <= 0.0f) | bits_of(nearest * nearest <= splat.reach * squared * (cc * cc));
  return reached & bits_of(c > field);
}

size_t sphere_tiles_reached(const View& view, const float* splats, const Extent* extents, int count, uint32_t number,
                            uint32_t* reached, Found* out) {
  constexpr float kSlack = 0.05f;  // of a box [pixel]
  const int tiles_x = (view.width + kTileSize - 1) / kTileSize, tiles_y = (view.height + kTileSize - 1) / kTileSize;
  const float width = static_cast<float>(view.width);
  const auto tile_at = [](float pixel, int tiles) {
    return static_cast<int>(std::clamp(pixel / kTileSize, 0.0f, static_cast<float>(tiles - 1)));
  };
  // Blocks of the last tiles that lie in the picture.
  const int last_columns = (view.width - (tiles_x - 1) * kTileSize + 3) / 4;
  const int last_rows = (view.height - (tiles_y - 1) * kTileSize + 3) / 4;
  const uint32_t in_last_column = ((1u << last_columns) - 1) * 0x1111u, in_last_row = (1u << (4 * last_rows)) - 1;
  size_t found = 0;
  for (int at = 0; at < count; ++at) {
    const SphereSplat& splat = reinterpret_cast<const SphereSplat*>(splats)[at];
    const Extent& extent = extents[at];
    reached[at] = 0;
    if (extent.right < extent.left) continue;
    const int first_y = tile_at(extent.top - 0.5f - kSlack, tiles_y);
    const int last_y = tile_at(extent.bottom - 0.5f + kSlack, tiles_y);
    int first_x = 0, columns = tiles_x;
    const float span = extent.right - extent.left;
    if (span < width - kTileSize) {
      const float left = extent.left - width * __builtin_floorf(extent.left / width);
      const float right = left + span - 0.5f + kSlack;
      first_x = tile_at(left - 0.5f - kSlack, tiles_x);
      columns = tile_at(right, tiles_x) - first_x + 1;
      if (right >= width) columns = tiles_x - first_x + 1 + tile_at(right - width, tiles_x);
      if (columns > tiles_x) columns = tiles_x;
    }
    const size_t before = found;
    for (int tile_y = first_y; tile_y <= last_y; ++tile_y) {
      for (int column = first_x; column < first_x + columns; ++column) {
        const int tile_x = column < tiles_x ? column : column - tiles_x;
        uint32_t blocks = blocks_reached(view, splat, tile_x, tile_y);
        if (tile_x == tiles_x - 1) blocks &= in_last_column;
        if (tile_y == tiles_y - 1) blocks &= in_last_row;
        out[found] = {static_cast<uint32_t>(tile_y * tiles_x + tile_x), blocks, number + at, splat.depth};
        found += blocks != 0;
      }
    }
    reached[at] = static_cast<uint32_t>(found - before);
  }
  return found;
}

constexpr ShapeKernels sphere_kernels() {
  return {sizeof(SphereSplat) / sizeof(float), Sphere::kGeometry,    project_sphere, project_sphere_backward,
          sphere_tiles_reached,                blend<Sphere>,        blend_backward<Sphere>};
}

}  // namespace
