// Blending of one 16x16 tile, forward and backward, one 4x4 block of pixels in a vector.
//
// Both directions walk the tile's list front to back. With w = alpha T the picture is sum(w v) + T_end background. For
// the gradients g of the picture and h of the weight let s = g . v + h be what one unit of w is worth; then
//   d loss / d alpha = T s - (everything behind) / (1 - alpha),  everything behind = total - prefix,
//   total = g . picture + h weight, so neither a reverse list nor a division by T is needed.
// A pixel that has stopped keeps its transmittance with a negative sign.
#pragma once

#include "core/vector.hpp"
#include "splats/constants.hpp"
#include "splats/kernels.hpp"

namespace {

using namespace rf3dgs;

constexpr int kBlocks = 16;
constexpr float kColumns[kLanes] = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};
constexpr float kRows[kLanes] = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};

// The least d^T conic d over each block's pixel centres' rectangle decides: a convex form's least value over a rectangle
// lies on an edge that faces the centre, or is zero inside.
size_t tiles_reached(const Splat& splat, uint32_t index, const TileBox& box, int tiles_x, Found* out) {
  const float slope_y = -splat.b / splat.c, slope_x = -splat.b / splat.a, cut = splat.cut * 1.0001f + 1e-3f;
  const Vec lefts = 4.0f * load(kColumns) + (0.5f - splat.x), tops = 4.0f * load(kRows) + (0.5f - splat.y);
  size_t reached = 0;
  for (int tile_y = box.first_y; tile_y <= box.last_y; ++tile_y) {
    const Vec top = tops + static_cast<float>(tile_y * kTileSize), bottom = top + 3.0f;
    const Vec near_y = clamp_vec(Vec{}, top, bottom);
    for (int tile_x = box.first_x; tile_x <= box.last_x; ++tile_x) {
      const Vec left = lefts + static_cast<float>(tile_x * kTileSize), right = left + 3.0f;
      const Vec near_x = clamp_vec(Vec{}, left, right);
      const Vec edge_y = clamp_vec(near_x * slope_y, top, bottom), edge_x = clamp_vec(near_y * slope_x, left, right);
      const Vec first = splat.a * near_x * near_x + 2.0f * splat.b * near_x * edge_y + splat.c * edge_y * edge_y;
      const Vec second = splat.a * edge_x * edge_x + 2.0f * splat.b * edge_x * near_y + splat.c * near_y * near_y;
      const uint32_t blocks = bits_of(min_vec(first, second) <= cut);
      out[reached] = {static_cast<uint32_t>(tile_y * tiles_x + tile_x), index, blocks};
      reached += blocks != 0;
    }
  }
  return reached;
}

// What one splat does to one block: its alpha (zero where it does not count), the weight alpha T, and the new T.
struct Step {
  Vec dx, dy, alpha, weight, next;
  IntVec counts, unclamped;
};

RF_INLINE Step step_of(const Splat& splat, Vec x, Vec y, Vec transmittance) {
  Step step;
  step.dx = x - splat.x;
  step.dy = y - splat.y;
  const Vec power = -0.5f * (splat.a * step.dx * step.dx + splat.c * step.dy * step.dy) - splat.b * step.dx * step.dy;
  const Vec raw = splat.opacity * exp_vec(min_vec(power, Vec{}));
  step.unclamped = raw <= kAlphaMax;
  step.alpha = min_vec(raw, splat_vec(kAlphaMax));
  const Vec after = transmittance * (1.0f - step.alpha);
  const IntVec seen = (step.alpha >= kAlphaMin) & (transmittance > 0.0f);
  const IntVec fits = after >= kTransmittanceStop;
  step.counts = seen & fits;
  step.weight = select(step.counts, step.alpha * transmittance, Vec{});
  step.next = select(step.counts, after, select(seen, -transmittance, transmittance));
  return step;
}

// The pixels of a block inside the picture, as a transmittance of one; others count as stopped.
RF_INLINE Vec first_transmittance(Vec x, Vec y, int width, int height) {
  const IntVec inside = (x < static_cast<float>(width)) & (y < static_cast<float>(height));
  return select(inside, splat_vec(1.0f), splat_vec(-1.0f));
}

template <int C>
void blend_channels(const Tile& tile, float* picture, float* weight) {
  Vec x[kBlocks], y[kBlocks], transmittance[kBlocks], colour[kBlocks][C] = {};
  uint32_t alive = 0;
  for (int block = 0; block < kBlocks; ++block) {
    x[block] = load(kColumns) + (tile.x + 4 * (block % 4) + 0.5f);
    y[block] = load(kRows) + (tile.y + 4 * (block / 4) + 0.5f);
    transmittance[block] = first_transmittance(x[block], y[block], tile.width, tile.height);
    if (bits_of(transmittance[block] > 0.0f) != 0) alive |= 1u << block;
  }
  for (size_t at = 0; at < tile.count && alive != 0; ++at) {
    const Entry entry = tile.entries[at];
    const Splat& splat = tile.splats[entry.splat];
    const float* value = tile.values + static_cast<size_t>(entry.splat) * tile.channels + tile.first;
    for (uint32_t left = entry.blocks & alive; left != 0; left &= left - 1) {
      const int block = __builtin_ctz(left);
      const Step step = step_of(splat, x[block], y[block], transmittance[block]);
      transmittance[block] = step.next;
      for (int channel = 0; channel < C; ++channel) colour[block][channel] += step.weight * value[channel];
      if (!any_positive(step.next)) alive &= ~(1u << block);
    }
  }
  for (int block = 0; block < kBlocks; ++block) {
    const int block_x = tile.x + 4 * (block % 4), block_y = tile.y + 4 * (block / 4);
    for (int lane = 0; lane < kLanes; ++lane) {
      const int col = block_x + lane % 4, row = block_y + lane / 4;
      if (col >= tile.width || row >= tile.height) continue;
      const size_t pixel = static_cast<size_t>(row) * tile.width + col;
      const float through = __builtin_fabsf(transmittance[block][lane]);
      if (tile.first == 0) weight[pixel] = 1.0f - through;
      for (int channel = 0; channel < C; ++channel) {
        const float behind = tile.background != nullptr ? tile.background[tile.first + channel] * through : 0.0f;
        picture[pixel * tile.channels + tile.first + channel] = colour[block][channel][lane] + behind;
      }
    }
  }
}

template <int C, bool kGeometry>
void blend_channels_backward(const Tile& tile, const float* picture, const float* weight, const float* picture_gradient,
                             const float* weight_gradient, float* rows) {
  constexpr int kRow = gradient_row(C, kGeometry);
  Vec x[kBlocks], y[kBlocks], transmittance[kBlocks], behind[kBlocks], h[kBlocks], g[kBlocks][C];
  uint32_t alive = 0;
  for (int block = 0; block < kBlocks; ++block) {
    x[block] = load(kColumns) + (tile.x + 4 * (block % 4) + 0.5f);
    y[block] = load(kRows) + (tile.y + 4 * (block / 4) + 0.5f);
    transmittance[block] = first_transmittance(x[block], y[block], tile.width, tile.height);
    if (bits_of(transmittance[block] > 0.0f) != 0) alive |= 1u << block;
    alignas(64) float total[kLanes] = {}, of_weight[kLanes] = {}, of_channel[C][kLanes] = {};
    for (int lane = 0; lane < kLanes; ++lane) {
      const int col = tile.x + 4 * (block % 4) + lane % 4, row = tile.y + 4 * (block / 4) + lane / 4;
      if (col >= tile.width || row >= tile.height) continue;
      const size_t pixel = static_cast<size_t>(row) * tile.width + col;
      if (tile.first == 0 && weight_gradient != nullptr) {
        of_weight[lane] = weight_gradient[pixel];
        total[lane] = weight_gradient[pixel] * weight[pixel];
      }
      for (int channel = 0; channel < C; ++channel) {
        const size_t at = pixel * tile.channels + tile.first + channel;
        of_channel[channel][lane] = picture_gradient[at];
        total[lane] += picture_gradient[at] * picture[at];
      }
    }
    behind[block] = load(total);
    h[block] = load(of_weight);
    for (int channel = 0; channel < C; ++channel) g[block][channel] = load(of_channel[channel]);
  }
  size_t at = 0;
  for (; at < tile.count && alive != 0; ++at) {
    const Entry entry = tile.entries[at];
    const Splat& splat = tile.splats[entry.splat];
    const float* value = tile.values + static_cast<size_t>(entry.splat) * tile.channels + tile.first;
    Vec sums[kRow] = {};  // of values, opacity, and x, y, xx, xy, yy about the centre
    for (uint32_t left = entry.blocks & alive; left != 0; left &= left - 1) {
      const int block = __builtin_ctz(left);
      const Step step = step_of(splat, x[block], y[block], transmittance[block]);
      Vec worth = h[block];
      for (int channel = 0; channel < C; ++channel) {
        worth += g[block][channel] * value[channel];
        sums[channel] += step.weight * g[block][channel];
      }
      behind[block] -= step.weight * worth;
      const Vec of_alpha = transmittance[block] * worth - behind[block] / (1.0f - step.alpha);
      const Vec of_power = select(step.counts & step.unclamped, of_alpha * step.alpha, Vec{});
      transmittance[block] = step.next;
      sums[C] += of_power;
      if constexpr (kGeometry) {
        const Vec x_part = of_power * step.dx, y_part = of_power * step.dy;
        sums[C + 1] += x_part;
        sums[C + 2] += y_part;
        sums[C + 3] += x_part * step.dx;
        sums[C + 4] += x_part * step.dy;
        sums[C + 5] += y_part * step.dy;
      }
      if (!any_positive(step.next)) alive &= ~(1u << block);
    }
    float* out = rows + at * kRow;
    sums_of<kRow>(sums, out);
    out[C] /= splat.opacity;
    if constexpr (kGeometry) {
      const float along_x = out[C + 1], along_y = out[C + 2];
      out[C + 1] = splat.a * along_x + splat.b * along_y;
      out[C + 2] = splat.b * along_x + splat.c * along_y;
      out[C + 3] *= -0.5f;
      out[C + 4] *= -1.0f;
      out[C + 5] *= -0.5f;
    }
  }
  std::memset(rows + at * kRow, 0, (tile.count - at) * kRow * sizeof(float));
}

void blend(const Tile& tile, float* picture, float* weight) {
  switch (tile.chunk) {
    case 1: return blend_channels<1>(tile, picture, weight);
    case 2: return blend_channels<2>(tile, picture, weight);
    case 3: return blend_channels<3>(tile, picture, weight);
    case 4: return blend_channels<4>(tile, picture, weight);
    case 5: return blend_channels<5>(tile, picture, weight);
    default: return blend_channels<8>(tile, picture, weight);
  }
}

template <int C>
void choose_geometry(const Tile& tile, const float* picture, const float* weight, const float* picture_gradient,
                     const float* weight_gradient, bool geometry, float* rows) {
  if (geometry) {
    blend_channels_backward<C, true>(tile, picture, weight, picture_gradient, weight_gradient, rows);
  } else {
    blend_channels_backward<C, false>(tile, picture, weight, picture_gradient, weight_gradient, rows);
  }
}

void blend_backward(const Tile& tile, const float* picture, const float* weight, const float* picture_gradient,
                    const float* weight_gradient, bool geometry, float* rows) {
  const auto chosen = [&] {
    switch (tile.chunk) {
      case 1: return choose_geometry<1>;
      case 2: return choose_geometry<2>;
      case 3: return choose_geometry<3>;
      case 4: return choose_geometry<4>;
      case 5: return choose_geometry<5>;
      default: return choose_geometry<8>;
    }
  }();
  chosen(tile, picture, weight, picture_gradient, weight_gradient, geometry, rows);
}

}  // namespace
