// What is done to a composited picture, pixel by pixel, and its derivative:
//
//   v = raw / weight where it is to be normalised (0 where nothing was drawn), then v + added,
//   then in the window of decibels  gain ln(1 + max(v, 0) / floor).
//
// Sixteen pixels of C channels are C vectors; which lane holds which channel repeats from one sixteen to the next.
#pragma once

#include "core/vector.hpp"
#include "splats/training_kernels.hpp"

namespace {

using namespace rf3dgs;

// ln x for positive normal x: with x = 2^e m and m between sqrt(1/2) and sqrt(2), ln m = 2 artanh((m - 1) / (m + 1)).
RF_INLINE Vec log_vec(Vec x) {
  const IntVec bits = int_bits(x);
  const IntVec exponent = (bits + -0x3f3504f3) & -0x800000;
  const Vec m = float_bits(bits - exponent), s = (m - 1.0f) / (m + 1.0f), ss = s * s;
  const Vec series = ss * (1.0f / 3.0f + ss * (0.2f + ss * (1.0f / 7.0f + ss * (1.0f / 9.0f))));
  return 2.0f * s + (2.0f * s * series + to_float(exponent) * (0.693147180559945f / 0x800000));
}

// Sixteen pixels or fewer, copied to where whole vectors may be read.
struct PixelBlock {
  const Finishing& how;
  int pixels, floats;

  RF_INLINE void read(const float* from, float* to) const {
    std::memcpy(to, from, floats * sizeof(float));
    std::memset(to + floats, 0, (kLanes * how.channels - floats) * sizeof(float));
  }
  // One divided by each float's weight, 0 where there is none.
  RF_INLINE void inverse_weights(const float* weight, float* to) const {
    for (int pixel = 0; pixel < kLanes; ++pixel) {
      const float inverse = pixel < pixels && weight[pixel] > 0.0f ? 1.0f / weight[pixel] : 0.0f;
      for (int channel = 0; channel < how.channels; ++channel) to[pixel * how.channels + channel] = inverse;
    }
  }
};

// Calls work(block, first pixel) for every sixteen pixels.
template <class Work>
RF_INLINE void each_block(const Finishing& how, size_t count, Work work) {
  for (size_t first = 0; first < count; first += kLanes) {
    const int pixels = static_cast<int>(count - first < kLanes ? count - first : kLanes);
    work(PixelBlock{how, pixels, pixels * how.channels}, first);
  }
}

// All ones in the lanes whose channel is in the window.
RF_INLINE void window_lanes(const Finishing& how, float* to) {
  for (int at = 0; at < kLanes * how.channels; ++at) {
    to[at] = how.in_window != nullptr && how.in_window[at % how.channels] ? 1.0f : 0.0f;
  }
}

void finish(const Finishing& how, size_t count, const float* raw, const float* weight, const float* added, float* out) {
  alignas(64) float window[kMostFinished * kLanes], value[kMostFinished * kLanes], other[kMostFinished * kLanes];
  const int lanes = kLanes * how.channels;
  window_lanes(how, window);
  each_block(how, count, [&](const PixelBlock& block, size_t first) {
    const size_t at = first * how.channels;
    block.read(raw + at, value);
    if (how.normalise) {
      block.inverse_weights(weight + first, other);
      for (int lane = 0; lane < lanes; lane += kLanes) store(value + lane, load(value + lane) * load(other + lane));
    }
    if (added != nullptr) {
      block.read(added + at, other);
      for (int lane = 0; lane < lanes; lane += kLanes) store(value + lane, load(value + lane) + load(other + lane));
    }
    if (how.in_window != nullptr) {
      for (int lane = 0; lane < lanes; lane += kLanes) {
        const Vec v = load(value + lane), power = 1.0f + select(v < 0.0f, Vec{}, v) * how.inverse_floor;
        const Vec level = how.gain * log_vec(power) + (power - power);  // what is not finite stays so
        store(value + lane, select(load(window + lane) > 0.0f, level, v));
      }
    }
    std::memcpy(out + at, value, block.floats * sizeof(float));
  });
}

void finish_backward(const Finishing& how, size_t count, const float* raw, const float* weight, const float* added,
                     const float* gradient, float* raw_gradient, float* weight_gradient) {
  alignas(64) float window[kMostFinished * kLanes], value[kMostFinished * kLanes], other[kMostFinished * kLanes];
  alignas(64) float inverse[kMostFinished * kLanes], of[kMostFinished * kLanes];
  const int lanes = kLanes * how.channels;
  window_lanes(how, window);
  each_block(how, count, [&](const PixelBlock& block, size_t first) {
    const size_t at = first * how.channels;
    block.read(gradient + at, of);
    block.read(raw + at, value);
    if (how.normalise) {
      block.inverse_weights(weight + first, inverse);
      for (int lane = 0; lane < lanes; lane += kLanes) store(value + lane, load(value + lane) * load(inverse + lane));
    }
    if (how.in_window != nullptr) {
      if (added != nullptr) block.read(added + at, other);
      for (int lane = 0; lane < lanes; lane += kLanes) {
        const Vec v = added == nullptr ? load(value + lane) : load(value + lane) + load(other + lane);
        const Vec slope = select(v < 0.0f, Vec{}, how.gain * how.inverse_floor / (1.0f + v * how.inverse_floor));
        store(of + lane, load(of + lane) * select(load(window + lane) > 0.0f, slope, splat_vec(1.0f)));
      }
    }
    if (how.normalise) {
      for (int lane = 0; lane < lanes; lane += kLanes) store(of + lane, load(of + lane) * load(inverse + lane));
      for (int pixel = 0; pixel < block.pixels; ++pixel) {
        float sum = 0.0f;
        for (int lane = pixel * how.channels; lane < (pixel + 1) * how.channels; ++lane) sum += of[lane] * value[lane];
        weight_gradient[first + pixel] -= sum;
      }
    }
    std::memcpy(raw_gradient + at, of, block.floats * sizeof(float));
  });
}

}  // namespace
