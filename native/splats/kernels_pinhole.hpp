// The shape of Gaussians in a pinhole picture (see kernels_blend.hpp): projected to the plane, drawn as ellipses.
#pragma once

#include <algorithm>

#include "core/rows.hpp"
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
    const Vec u = mul_add(splat_vec(splat.p), point.dx, splat.r * point.dy), v = splat.s * point.dy;
    return mul_from(v, v, mul_from(u, u, splat_vec(splat.peak)));
  }

  // g d and g d d^T.
  static constexpr int kGeometry = 5;
  static RF_INLINE void geometry_parts(const Point& point, const Vec& g, Vec* sums) {
    const Vec gx = g * point.dx, gy = g * point.dy;
    sums[0] = gx;
    sums[1] = gy;
    sums[2] = gx * point.dx;
    sums[3] = gx * point.dy;
    sums[4] = gy * point.dy;
  }
};

// The ellipse outside which alpha is below the cut, as what a row of blocks needs of it. Every block row is a band of
// pixel centres; the part of a convex figure in a band reaches from its leftmost to its rightmost point there, and a
// block counts when it has a column of pixel centres between the two.
struct Ellipse {
  Vec x, y, inverse_p, r, s, cut, turn, height;
};

RF_INLINE Ellipse ellipse_of(Vec x, Vec y, Vec p, Vec r, Vec s, Vec peak) {
  Ellipse e{x, y, 1.0f / p, r, s, (peak - kLog2AlphaMin) * 1.0001f + 1e-3f, {}, {}};
  e.height = sqrt_vec(e.cut) / s;
  e.turn = -e.height * r / sqrt_vec(r * r + s * s);  // where the rightmost point lies; the leftmost is opposite
  return e;
}

constexpr float kSlack = 0.01f;  // pixels that rounding may cost

// The first and one more than the last column of pixels, first <= column < beyond, that a band of four rows of pixels
// from `row` on holds of the ellipse.
RF_INLINE void columns_of_band(const Ellipse& e, Vec row, Vec first, Vec beyond, IntVec& from, IntVec& to) {
  const Vec top = row + 0.5f - e.y, bottom = top + 3.0f, none = Vec{};
  const Vec right = clamp_vec(clamp_vec(e.turn, top, bottom), -e.height, e.height);
  const Vec left = clamp_vec(clamp_vec(-e.turn, top, bottom), -e.height, e.height);
  const Vec right_v = e.s * right, left_v = e.s * left;
  const Vec right_x = e.x + (sqrt_vec(max_vec(e.cut - right_v * right_v, none)) - e.r * right) * e.inverse_p;
  const Vec left_x = e.x - (sqrt_vec(max_vec(e.cut - left_v * left_v, none)) + e.r * left) * e.inverse_p;
  from = to_int(clamp_vec(left_x + (0.5f - kSlack), first, beyond));
  to = to_int(clamp_vec(right_x + (0.5f + kSlack), first, beyond));
}

RF_INLINE void put_found(Found* out, uint32_t tile, uint32_t blocks, uint32_t splat, float depth) {
  const Found found = {tile, blocks, splat, depth};
  std::memcpy(out, &found, sizeof(found));
}

// A splat of any size: sixteen rows of blocks, which are four rows of tiles, at a time. The box holds the first pixels
// and those beyond the last.
Found* tiles_of_large(const PinholeSplat& splat, const int32_t* box, int tiles_x, uint32_t number, Found* out) {
  const Ellipse e = ellipse_of(splat_vec(splat.x), splat_vec(splat.y), splat_vec(splat.p), splat_vec(splat.r),
                               splat_vec(splat.s), splat_vec(splat.peak));
  const Vec first = splat_vec(static_cast<float>(box[0])), beyond = splat_vec(static_cast<float>(box[2]));
  const Vec lanes = load(kColumns) + 4.0f * load(kRows);
  const int last_x = (box[2] - 1) / kTileSize, last_y = (box[3] - 1) / kTileSize;
  for (int start = box[1] / kTileSize; start <= last_y; start += 4) {
    IntVec begin, end;
    columns_of_band(e, 4.0f * lanes + static_cast<float>(start * kTileSize), first, beyond, begin, end);
    int32_t from[kLanes], to[kLanes];
    store_ints(from, begin);
    store_ints(to, end);
    for (int tile_y = start; tile_y < start + 4 && tile_y <= last_y; ++tile_y) {
      for (int tile_x = box[0] / kTileSize; tile_x <= last_x; ++tile_x) {
        uint32_t blocks = 0;
        for (int row = 0; row < 4; ++row) {
          const int band = 4 * (tile_y - start) + row, y = tile_y * kTileSize + 4 * row;
          if (from[band] >= to[band] || y + 4 <= box[1] || y >= box[3]) continue;
          const int low = std::max(from[band] / 4 - 4 * tile_x, 0), high = std::min((to[band] - 1) / 4 - 4 * tile_x, 3);
          if (low <= high) blocks |= ((2u << high) - (1u << low)) << (4 * row);
        }
        put_found(out, tile_y * tiles_x + tile_x, blocks, number, splat.depth);
        out += blocks != 0;
      }
    }
  }
  return out;
}

// Sixteen splats side by side as long as each fits into four rows of blocks and two columns of tiles.
size_t tiles_reached(const View& view, const float* splats, const Extent* extents, int count, uint32_t number,
                     uint32_t* reached, Found* out) {
  constexpr int kBands = 4;
  const int tiles_x = (view.width + kTileSize - 1) / kTileSize;
  const PinholeSplat* const splat = reinterpret_cast<const PinholeSplat*>(splats);
  Vec parts[8], extent[4];
  load_columns_from<8>(splats, count, parts);
  load_columns_from<4>(&extents[0].left, count, extent);
  const Vec none = Vec{}, width = splat_vec(static_cast<float>(view.width));
  const Vec height = splat_vec(static_cast<float>(view.height));
  // The first pixels whose centres may lie inside, and those beyond the last.
  const IntVec left = to_int(clamp_vec(extent[0] + (0.5f - kSlack), none, width));
  const IntVec top = to_int(clamp_vec(extent[1] + (0.5f - kSlack), none, height));
  const IntVec right = to_int(clamp_vec(extent[2] + (0.5f + kSlack), none, width));
  const IntVec bottom = to_int(clamp_vec(extent[3] + (0.5f + kSlack), none, height));
  const Ellipse e = ellipse_of(parts[0], parts[1], parts[2], parts[3], parts[4], parts[5]);
  const IntVec tile_x = left >> 4, tile_y = top >> 4, first_band = (top >> 2) << 2;
  // The blocks of two columns of tiles, up to eight rows of four bits each.
  IntVec columns[2] = {};
  for (int band = 0; band < kBands; ++band) {
    const IntVec row = first_band + 4 * band, within = row < bottom;
    if (bits_of(within) == 0) break;
    IntVec from, to;
    columns_of_band(e, to_float(row), to_float(left), to_float(right), from, to);
    const IntVec some = within & (from < to), one = splat_int(1);
    const IntVec low = (from >> 2) - (tile_x << 2), high = ((to + -1) >> 2) - (tile_x << 2);
    const IntVec blocks = some & (((one + one) << high) - (one << low));
    const IntVec shift = (row - (tile_y << 4)) & ~3;
    columns[0] = columns[0] | ((blocks & 15) << shift);
    columns[1] = columns[1] | (((blocks >> 4) & 15) << shift);
  }
  const IntVec fits = (bottom <= first_band + 4 * kBands) & (((right + -1) >> 4) <= tile_x + 1);
  const uint32_t empty = ~bits_of((left < right) & (top < bottom));
  const uint32_t large = ~bits_of(fits);
  alignas(64) int32_t near[kLanes], blocks[2][kLanes], box[4][kLanes];
  store_ints(near, tile_y);
  store_ints(blocks[0], columns[0]);
  store_ints(blocks[1], columns[1]);
  store_ints(box[0], left);
  store_ints(box[1], top);
  store_ints(box[2], right);
  store_ints(box[3], bottom);
  Found* next = out;
  for (int at = 0; at < count; ++at) {
    Found* const before = next;
    const uint32_t name = number + at;
    if (((large | empty) >> at & 1) == 0) {
      const uint32_t tile = near[at] * tiles_x + (box[0][at] >> 4), one = blocks[0][at], two = blocks[1][at];
      const float depth = splat[at].depth;
      put_found(next, tile, one & 0xffff, name, depth);
      next += (one & 0xffff) != 0;
      put_found(next, tile + 1, two & 0xffff, name, depth);
      next += (two & 0xffff) != 0;
      put_found(next, tile + tiles_x, one >> 16, name, depth);
      next += one >> 16 != 0;
      put_found(next, tile + tiles_x + 1, two >> 16, name, depth);
      next += two >> 16 != 0;
    } else if ((empty >> at & 1) == 0) {
      const int32_t corners[4] = {box[0][at], box[1][at], box[2][at], box[3][at]};
      next = tiles_of_large(splat[at], corners, tiles_x, name, next);
    }
    reached[at] = static_cast<uint32_t>(next - before);
  }
  return next - out;
}

constexpr ShapeKernels pinhole_kernels() {
  return {sizeof(PinholeSplat) / sizeof(float), Pinhole::kGeometry, project, project_backward, tiles_reached,
          blend<Pinhole>, blend_backward<Pinhole>};
}

}  // namespace
