// Blending of one 16x16 tile, forward and backward, one 4x4 block of pixels in a vector, for splats of any shape.
//
// Both directions walk the tile's list front to back. With w = alpha T the picture is sum(w v) + T_end background. For
// the gradients g of the picture and h of the weight let s = g . v + h be what one unit of w is worth; then
//   d loss / d alpha = T s - (everything behind) / (1 - alpha),  everything behind = total - prefix,
//   total = g . picture + h weight, so neither a reverse list nor a division by T is needed.
// A pixel that has stopped keeps its transmittance with a negative sign. With a gate, a pixel stops at the first splat
// that lies further than the gate behind the one that took its transmittance below one half.
//
// A shape is a struct with
//   Splat          what is drawn: plain floats, `depth` among them
//   Pixels, pixels(view, x, y)                 what a block's sixteen pixels are to it; (x, y) is the first of them
//   Point, log2_alpha(splat, pixels, point)    log2 of alpha before its limit, and what the derivative needs of it
//   kGeometry, add_geometry(point, g, sums)    adds g = d loss / d ln alpha times what the shape's geometry needs
#pragma once

#include "core/vector.hpp"
#include "splats/constants.hpp"
#include "splats/kernels.hpp"

namespace {

using namespace rf3dgs;

constexpr int kBlocks = 16;
constexpr float kColumns[kLanes] = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};
constexpr float kRows[kLanes] = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};

// Pixels of one block: inside the picture they start with a transmittance of one, others count as stopped.
template <class Shape, bool kGate>
struct Block {
  typename Shape::Pixels pixels;
  Vec transmittance;
  Vec limit;  // of depth, with a gate
};

template <class Shape, bool kGate>
RF_INLINE uint32_t start_blocks(const Tile& tile, Block<Shape, kGate>* blocks) {
  uint32_t alive = 0;
  for (int at = 0; at < kBlocks; ++at) {
    const int block_x = tile.x + 4 * (at % 4), block_y = tile.y + 4 * (at / 4);
    const Vec x = load(kColumns) + static_cast<float>(block_x), y = load(kRows) + static_cast<float>(block_y);
    const IntVec inside = (x < static_cast<float>(tile.view->width)) & (y < static_cast<float>(tile.view->height));
    blocks[at].pixels = Shape::pixels(*tile.view, block_x, block_y);
    blocks[at].transmittance = select(inside, splat_vec(1.0f), splat_vec(-1.0f));
    if constexpr (kGate) blocks[at].limit = splat_vec(__builtin_inff());
    if (bits_of(inside) != 0) alive |= 1u << at;
  }
  return alive;
}

// What one splat does to one block: its alpha, the weight alpha T (zero where it does not count), and T before it.
template <class Shape>
struct Step {
  typename Shape::Point point;
  Vec alpha, weight, before;
  IntVec counts, unclamped;
};

template <class Shape, bool kGate>
RF_INLINE Step<Shape> step_of(const Tile& tile, const typename Shape::Splat& splat, Block<Shape, kGate>& block) {
  Step<Shape> step;
  const Vec transmittance = step.before = block.transmittance;
  const Vec raw = exp2_vec(Shape::log2_alpha(splat, block.pixels, step.point));
  step.unclamped = raw <= kAlphaMax;
  step.alpha = min_vec(raw, splat_vec(kAlphaMax));
  const Vec after = transmittance * (1.0f - step.alpha);
  const IntVec seen = (step.alpha >= kAlphaMin) & (transmittance > 0.0f);
  IntVec fits = after >= kTransmittanceStop;
  if constexpr (kGate) fits &= block.limit >= splat.depth;
  step.counts = seen & fits;
  step.weight = select(step.counts, step.alpha * transmittance, Vec{});
  block.transmittance = select(step.counts, after, select(seen, -transmittance, transmittance));
  if constexpr (kGate) {
    const IntVec takes_half = step.counts & (transmittance >= 0.5f) & (after < 0.5f);
    block.limit = select(takes_half, splat_vec(splat.depth + tile.gate), block.limit);
  }
  return step;
}

template <class Shape>
RF_INLINE const typename Shape::Splat& splat_of(const Tile& tile, const Entry& entry) {
  return reinterpret_cast<const typename Shape::Splat*>(tile.splats)[entry.splat];
}

RF_INLINE const float* value_of(const Tile& tile, const Entry& entry) {
  return tile.values + static_cast<size_t>(entry.splat) * tile.channels + tile.first;
}

// Calls pixel(lane, index of the pixel) for the lanes of a block inside the picture.
template <class Function>
RF_INLINE void each_pixel(const Tile& tile, int block, const Function& pixel) {
  const int block_x = tile.x + 4 * (block % 4), block_y = tile.y + 4 * (block / 4);
  for (int lane = 0; lane < kLanes; ++lane) {
    const int col = block_x + lane % 4, row = block_y + lane / 4;
    if (col < tile.view->width && row < tile.view->height) {
      pixel(lane, static_cast<size_t>(row) * tile.view->width + col);
    }
  }
}

template <class Shape, int C, bool kGate>
void blend_channels(const Tile& tile, const Blended& out) {
  Block<Shape, kGate> blocks[kBlocks];
  Vec colour[kBlocks][C] = {};
  uint32_t alive = start_blocks<Shape, kGate>(tile, blocks);
  for (size_t at = 0; at < tile.count; ++at) {
    const Entry& entry = tile.entries[at];
    const typename Shape::Splat& splat = splat_of<Shape>(tile, entry);
    const float* value = value_of(tile, entry);
    Vec peak = {};
    for (uint32_t left = entry.blocks & alive; left != 0; left &= left - 1) {
      const int block = __builtin_ctz(left);
      const Step<Shape> step = step_of<Shape, kGate>(tile, splat, blocks[block]);
      for (int channel = 0; channel < C; ++channel) colour[block][channel] += step.weight * value[channel];
      if (out.peaks != nullptr) peak = max_vec(peak, step.weight);
      if (!any_positive(blocks[block].transmittance)) alive &= ~(1u << block);
    }
    if (out.peaks != nullptr) out.peaks[entry.slot] = largest_of(peak);
    else if (alive == 0) break;
  }
  for (int block = 0; block < kBlocks; ++block) {
    each_pixel(tile, block, [&](int lane, size_t pixel) {
      const float through = __builtin_fabsf(blocks[block].transmittance[lane]);
      if (tile.first == 0) out.weight[pixel] = 1.0f - through;
      for (int channel = 0; channel < C; ++channel) {
        const float behind = out.background != nullptr ? out.background[tile.first + channel] * through : 0.0f;
        out.picture[pixel * tile.channels + tile.first + channel] = colour[block][channel][lane] + behind;
      }
    });
  }
}

template <class Shape, int C, bool kGeometry, bool kGate>
void blend_channels_backward(const Tile& tile, const Slopes& slopes) {
  constexpr int kRow = gradient_row(C, kGeometry ? Shape::kGeometry : 0);
  Block<Shape, kGate> blocks[kBlocks];
  Vec behind[kBlocks], g[kBlocks][C], h[kBlocks];
  uint32_t alive = start_blocks<Shape, kGate>(tile, blocks);
  for (int block = 0; block < kBlocks; ++block) {
    alignas(64) float of_values[C][kLanes] = {}, of_weight[kLanes] = {}, total[kLanes] = {};
    each_pixel(tile, block, [&](int lane, size_t pixel) {
      // The weight belongs to all channels together: its gradient is added once.
      if (slopes.weight_gradient != nullptr && tile.first == 0) of_weight[lane] = slopes.weight_gradient[pixel];
      total[lane] = of_weight[lane] * slopes.weight[pixel];
      for (int channel = 0; channel < C; ++channel) {
        const size_t at = pixel * tile.channels + tile.first + channel;
        of_values[channel][lane] = slopes.picture_gradient[at];
        total[lane] += slopes.picture_gradient[at] * slopes.picture[at];
      }
    });
    behind[block] = load(total);
    h[block] = load(of_weight);
    for (int channel = 0; channel < C; ++channel) g[block][channel] = load(of_values[channel]);
  }
  for (size_t at = 0; at < tile.count; ++at) {
    const Entry& entry = tile.entries[at];
    const typename Shape::Splat& splat = splat_of<Shape>(tile, entry);
    const float* value = value_of(tile, entry);
    Vec sums[kRow] = {};
    for (uint32_t left = entry.blocks & alive; left != 0; left &= left - 1) {
      const int block = __builtin_ctz(left);
      const Step<Shape> step = step_of<Shape, kGate>(tile, splat, blocks[block]);
      Vec worth = h[block];
      for (int channel = 0; channel < C; ++channel) {
        worth += g[block][channel] * value[channel];
        sums[channel] += step.weight * g[block][channel];
      }
      behind[block] -= step.weight * worth;
      const Vec of_alpha = step.before * worth - behind[block] / (1.0f - step.alpha);
      const Vec of_power = select(step.counts & step.unclamped, of_alpha * step.alpha, Vec{});
      sums[C] += of_power;
      if constexpr (kGeometry) Shape::add_geometry(step.point, of_power, sums + C + 1);
      if (!any_positive(blocks[block].transmittance)) alive &= ~(1u << block);
    }
    sums_of<kRow>(sums, slopes.rows + static_cast<size_t>(entry.slot) * kRow);
  }
}

template <class Shape, int C>
void blend_chosen(const Tile& tile, const Blended& out) {
  return tile.gate < __builtin_inff() ? blend_channels<Shape, C, true>(tile, out)
                                      : blend_channels<Shape, C, false>(tile, out);
}

template <class Shape>
void blend(const Tile& tile, const Blended& out) {
  switch (tile.chunk) {
    case 1: return blend_chosen<Shape, 1>(tile, out);
    case 2: return blend_chosen<Shape, 2>(tile, out);
    case 3: return blend_chosen<Shape, 3>(tile, out);
    case 4: return blend_chosen<Shape, 4>(tile, out);
    case 5: return blend_chosen<Shape, 5>(tile, out);
    default: return blend_chosen<Shape, 8>(tile, out);
  }
}

template <class Shape, int C>
void blend_backward_chosen(const Tile& tile, const Slopes& slopes) {
  if (tile.gate < __builtin_inff()) {
    return slopes.geometry ? blend_channels_backward<Shape, C, true, true>(tile, slopes)
                           : blend_channels_backward<Shape, C, false, true>(tile, slopes);
  }
  return slopes.geometry ? blend_channels_backward<Shape, C, true, false>(tile, slopes)
                         : blend_channels_backward<Shape, C, false, false>(tile, slopes);
}

template <class Shape>
void blend_backward(const Tile& tile, const Slopes& slopes) {
  switch (tile.chunk) {
    case 1: return blend_backward_chosen<Shape, 1>(tile, slopes);
    case 2: return blend_backward_chosen<Shape, 2>(tile, slopes);
    case 3: return blend_backward_chosen<Shape, 3>(tile, slopes);
    case 4: return blend_backward_chosen<Shape, 4>(tile, slopes);
    case 5: return blend_backward_chosen<Shape, 5>(tile, slopes);
    default: return blend_backward_chosen<Shape, 8>(tile, slopes);
  }
}

}  // namespace
