// Blending of one 16x16 tile, forward and backward, for splats of any shape. One 4x4 block of pixels is one vector.
//
// The tile's list is taken in batches. A batch is copied together and taken apart into sixteen lists, one for each block,
// so that a block's pixels stay in registers while its list runs by. Both directions go front to back. With
// w = alpha T the picture is sum(w v) + T_end background. For the gradients g of the picture and h of the weight let
// s = g . v + h be what one unit of w is worth; then with everything behind = total - prefix
//   d loss / d ln alpha = w s - (everything behind) alpha / (1 - alpha),
//   total = g . picture + h weight, so neither a reverse list nor a division by T is needed.
//
// The product of all (1 - alpha) so far only falls: a splat counts while the product including it is not below the stop,
// so a pixel that has stopped needs no mark. With a gate, a splat counts while it lies no further than the gate behind
// the one that took the product below three quarters; the list is sorted, so such a pixel has stopped as well.
//
// A shape is a struct with
//   Splat                                       what is drawn: plain floats, `depth` among them
//   Pixels, pixels(view, x, y)                  what a block's sixteen pixels are to it; (x, y) is the first of them
//   Point, log2_alpha(splat, pixels, point)     log2 of alpha before its limit, and what the derivative needs of it
//   kGeometry, geometry_parts(point, g, parts)  what each pixel adds to the geometry sums for g = d loss / d ln alpha
#pragma once

#include "core/vector.hpp"
#include "splats/constants.hpp"
#include "splats/kernels.hpp"
#include "splats/kernels_batch.hpp"

namespace {

using namespace rf3dgs;

// Pixels of one block: the product of (1 - alpha) of all splats so far, where T ends, and the depth up to which splats
// count. A product of zero marks pixels outside the picture.
template <bool kGate>
struct Light {
  Vec product, through, limit;
};

template <bool kGate>
RF_INLINE Light<kGate> light_of_block(const View& view, int block_x, int block_y) {
  const Vec x = load(kColumns) + static_cast<float>(block_x), y = load(kRows) + static_cast<float>(block_y);
  const Vec width = splat_vec(static_cast<float>(view.width)), height = splat_vec(static_cast<float>(view.height));
  Light<kGate> light;
  light.through = splat_vec(1.0f);
  light.product = choose(below(x, width), choose(below(y, height), light.through, Vec{}), Vec{});
  light.limit = splat_vec(__builtin_inff());
  return light;
}

// What one splat does to one block: alpha (zero below the cut), the weight alpha T, and where it counts.
template <class Shape>
struct Step {
  typename Shape::Point point;
  Vec alpha, weight;
  Mask counts;
};

template <class Shape, bool kGate>
RF_INLINE Step<Shape> advance(const typename Shape::Splat& splat, const typename Shape::Pixels& pixels, float gate,
                              Light<kGate>& light) {
  Step<Shape> step;
  const Vec exponent = Shape::log2_alpha(splat, pixels, step.point);
  const Mask seen = at_least(exponent, splat_vec(kLog2AlphaMin));
  step.alpha = keep(seen, min_of_positive(exp2_vec(exponent), splat_vec(kAlphaMax)));
  const Vec weight = step.alpha * light.product, after = light.product - weight;
  step.counts = at_least(after, splat_vec(kTransmittanceStop));
  if constexpr (kGate) step.counts = both(step.counts, at_least(light.limit, splat_vec(splat.depth)));
  step.weight = keep(step.counts, weight);
  light.through = choose(step.counts, after, light.through);
  if constexpr (kGate) {
    const Mask sets_gate = both(step.counts, below(after, splat_vec(kGateTransmittance)));
    light.limit = min_vec(choose(sets_gate, splat_vec(splat.depth + gate), light.limit), light.limit);
  }
  light.product = after;
  return step;
}

template <class Shape, int C, bool kGate>
void blend_channels(const Tile& tile, const Blended& out) {
  Batch<Shape, C> batch;
  Light<kGate> lights[kBlocks];
  Vec colours[kBlocks][C] = {};
  for (int block = 0; block < kBlocks; ++block) {
    lights[block] = light_of_block<kGate>(*tile.view, block_x(tile, block), block_y(tile, block));
  }
  uint32_t alive = blocks_inside(tile);
  for (size_t begin = 0; begin < tile.count && alive != 0; begin += kBatch) {
    batch.take(tile, begin, alive);
    for (uint32_t left = alive; left != 0; left &= left - 1) {
      const int block = __builtin_ctz(left);
      const typename Shape::Pixels pixels = Shape::pixels(*tile.view, block_x(tile, block), block_y(tile, block));
      Light<kGate> light = lights[block];
      Vec colour[C];
      for (int channel = 0; channel < C; ++channel) colour[channel] = colours[block][channel];
      for (int at = 0; at < batch.listed[block]; ++at) {
        const Drawn<Shape, C>& drawn = batch.drawn[batch.list[block][at]];
        const Step<Shape> step = advance<Shape, kGate>(drawn.splat, pixels, tile.gate, light);
        for (int channel = 0; channel < C; ++channel) {
          colour[channel] = mul_add(step.weight, splat_vec(drawn.value[channel]), colour[channel]);
        }
        if (!any(step.counts)) {
          alive &= ~(1u << block);
          break;
        }
      }
      lights[block] = light;
      for (int channel = 0; channel < C; ++channel) colours[block][channel] = colour[channel];
    }
  }
  for (uint32_t left = blocks_inside(tile); left != 0; left &= left - 1) {
    const int block = __builtin_ctz(left);
    const Vec through = lights[block].through, weight = 1.0f - through;
    if (tile.first == 0) store_block<1>(tile, block, &weight, 1, 0, out.weight);
    if (out.background != nullptr) {
      for (int channel = 0; channel < C; ++channel) {
        colours[block][channel] += through * out.background[tile.first + channel];
      }
    }
    store_block<C>(tile, block, colours[block], tile.channels, tile.first, out.picture);
  }
}

// The largest weight alpha T of each entry over the tile's pixels.
template <class Shape, bool kGate>
void largest_weights(const Tile& tile, float* peaks) {
  Batch<Shape, 0> batch;
  Light<kGate> lights[kBlocks];
  for (int block = 0; block < kBlocks; ++block) {
    lights[block] = light_of_block<kGate>(*tile.view, block_x(tile, block), block_y(tile, block));
  }
  for (size_t begin = 0; begin < tile.count; begin += kBatch) {
    batch.take(tile, begin, blocks_inside(tile));
    float largest[kBatch] = {};
    for (int block = 0; block < kBlocks; ++block) {
      const typename Shape::Pixels pixels = Shape::pixels(*tile.view, block_x(tile, block), block_y(tile, block));
      for (int at = 0; at < batch.listed[block]; ++at) {
        const int index = batch.list[block][at];
        const Vec weight = advance<Shape, kGate>(batch.drawn[index].splat, pixels, tile.gate, lights[block]).weight;
        largest[index] = __builtin_fmaxf(largest[index], largest_of(weight));
      }
    }
    for (int at = 0; at < batch.count; ++at) peaks[tile.entries[begin + at].slot] = largest[at];
  }
}

// What a block's pixels carry through the backward pass.
template <int C>
struct Upstream {
  Vec behind, h, g[C];
};

template <int C>
RF_INLINE Upstream<C> upstream_of_block(const Tile& tile, const Slopes& slopes, int block) {
  Upstream<C> upstream{};
  Vec weight, values[C];
  // The weight belongs to all channels together: its gradient is added once.
  if (slopes.weight_gradient != nullptr && tile.first == 0) {
    load_block<1>(tile, block, slopes.weight_gradient, 1, 0, &upstream.h);
    load_block<1>(tile, block, slopes.weight, 1, 0, &weight);
    upstream.behind = upstream.h * weight;
  }
  load_block<C>(tile, block, slopes.picture_gradient, tile.channels, tile.first, upstream.g);
  load_block<C>(tile, block, slopes.picture, tile.channels, tile.first, values);
  for (int channel = 0; channel < C; ++channel) {
    upstream.behind = mul_add(upstream.g[channel], values[channel], upstream.behind);
  }
  return upstream;
}

// Vectors whose lanes are to be summed, of a few splats one after the other, on their way to the splats' rows.
template <int kSums, int kRow>
struct Pending {
  static constexpr int kMost = kSums <= 4 ? 8 : 4;
  Half parts[kMost * kSums];
  int index[kMost];
  int count = 0;

  RF_INLINE void take(int row, const Vec* sums) {
    for (int at = 0; at < kSums; ++at) parts[count * kSums + at] = halves_added(sums[at]);
    index[count++] = row;
  }

  RF_INLINE void add_to(float* rows) {
    alignas(64) float sums[kMost * kSums + 4];
    for (int at = 0; at < count * kSums; at += 4) four_sums(parts + at, sums + at);
    for (int at = 0; at < count; ++at) {
      float* const row = rows + index[at] * kRow;
      for (int column = 0; column < kRow; column += 4) {
        store_four(row + column, load_four(row + column) + load_four(sums + at * kSums + column));
      }
    }
    count = 0;
  }
};

template <class Shape, int C, bool kGeometry, bool kGate>
void blend_channels_backward(const Tile& tile, const Slopes& slopes) {
  constexpr int kSums = C + 1 + (kGeometry ? Shape::kGeometry : 0);
  constexpr int kRow = gradient_row(C, kGeometry ? Shape::kGeometry : 0);
  Batch<Shape, C> batch;
  Light<kGate> lights[kBlocks];
  Upstream<C> upstreams[kBlocks];
  Pending<kSums, kRow> pending;
  std::memset(pending.parts, 0, sizeof(pending.parts));
  alignas(64) float rows[kBatch * kRow];
  for (int block = 0; block < kBlocks; ++block) {
    lights[block] = light_of_block<kGate>(*tile.view, block_x(tile, block), block_y(tile, block));
    upstreams[block] = upstream_of_block<C>(tile, slopes, block);
  }
  uint32_t alive = blocks_inside(tile);
  for (size_t begin = 0; begin < tile.count; begin += kBatch) {
    batch.take(tile, begin, alive);
    std::memset(rows, 0, batch.count * kRow * sizeof(float));
    for (uint32_t left = alive; left != 0; left &= left - 1) {
      const int block = __builtin_ctz(left);
      const typename Shape::Pixels pixels = Shape::pixels(*tile.view, block_x(tile, block), block_y(tile, block));
      Light<kGate> light = lights[block];
      Upstream<C> upstream = upstreams[block];
      for (int at = 0; at < batch.listed[block]; ++at) {
        const int index = batch.list[block][at];
        const Drawn<Shape, C>& drawn = batch.drawn[index];
        const Step<Shape> step = advance<Shape, kGate>(drawn.splat, pixels, tile.gate, light);
        Vec parts[kSums];
        Vec worth = upstream.h;
        for (int channel = 0; channel < C; ++channel) {
          worth = mul_add(upstream.g[channel], splat_vec(drawn.value[channel]), worth);
          parts[channel] = step.weight * upstream.g[channel];
        }
        const Vec own = step.weight * worth;
        upstream.behind = upstream.behind - own;
        const Vec hidden = upstream.behind * (step.alpha * reciprocal(1.0f - step.alpha));
        const Mask free = both(step.counts, below(step.alpha, splat_vec(kAlphaMax)));
        parts[C] = keep(free, own - hidden);
        if constexpr (kGeometry) Shape::geometry_parts(step.point, parts[C], parts + C + 1);
        pending.take(index, parts);
        if (pending.count == pending.kMost) pending.add_to(rows);
        if (!any(step.counts)) {
          alive &= ~(1u << block);
          break;
        }
      }
      pending.add_to(rows);
      lights[block] = light;
      upstreams[block] = upstream;
    }
    for (int at = 0; at < batch.count; ++at) {
      std::memcpy(slopes.rows + static_cast<size_t>(tile.entries[begin + at].slot) * kRow, rows + at * kRow,
                  kRow * sizeof(float));
    }
  }
}

template <class Shape, int C>
void blend_chosen(const Tile& tile, const Blended& out) {
  return tile.gate < __builtin_inff() ? blend_channels<Shape, C, true>(tile, out)
                                      : blend_channels<Shape, C, false>(tile, out);
}

template <class Shape>
void blend(const Tile& tile, const Blended& out) {
  if (out.peaks != nullptr && tile.first == 0) {
    tile.gate < __builtin_inff() ? largest_weights<Shape, true>(tile, out.peaks)
                                 : largest_weights<Shape, false>(tile, out.peaks);
  }
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
