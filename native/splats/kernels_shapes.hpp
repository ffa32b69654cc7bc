// Adam for shape and opacity of Gaussians that a view drew, and how these are activated.
//
// The eleven numbers of a Gaussian are packed into one vector, so that their exponentials are taken together.
#pragma once

#include "core/vector.hpp"
#include "splats/kernels_adam.hpp"
#include "splats/training_kernels.hpp"

namespace {

using namespace rf3dgs;

// e^x within the range of floats; NaN becomes the largest.
RF_INLINE Vec exponential(Vec x) { return exp2_vec(min_vec(x * 1.44269504088896341f, splat_vec(127.0f))); }
RF_INLINE Vec sigmoid(Vec x) { return 1.0f / (1.0f + exponential(0.0f - x)); }

// Lanes of a packed row.
constexpr int kMean = 0, kQuat = 3, kScale = 7, kOpacity = 10, kShape = 11;

// One packed row of an array's parts, its values or one of its moments.
template <class Number>
struct Packed {
  alignas(64) Number lane[kLanes] = {};

  RF_INLINE void take(const void* from, size_t source, int columns, int at) {
    if (from == nullptr) return;
    std::memcpy(lane + at, static_cast<const Number*>(from) + source * columns, columns * sizeof(Number));
  }
  RF_INLINE void give(void* to, size_t source, int columns, int at) const {
    if (to == nullptr) return;
    std::memcpy(static_cast<Number*>(to) + source * columns, lane + at, columns * sizeof(Number));
  }
};

template <class Moment>
void update_shapes_with(const ShapeUpdate& update, const Adam& adam, const uint32_t* sources, size_t count,
                        const float* means, const float* quats, const float* scales, const float* opacities) {
  struct Part {
    Trained array;
    int columns, at;
  };
  const Part parts[4] = {{update.means, 3, kMean},
                         {update.quats, 4, kQuat},
                         {update.log_scales, 3, kScale},
                         {update.logit_opacities, 1, kOpacity}};
  Packed<float> rates;
  for (int at = 0; at < 3; ++at) rates.lane[kMean + at] = update.rate_means;
  for (int at = 0; at < 4; ++at) rates.lane[kQuat + at] = update.rate_quats;
  for (int at = 0; at < 3; ++at) rates.lane[kScale + at] = update.rate_log_scales;
  rates.lane[kOpacity] = update.rate_opacity;
  const bool geometry = update.means.value != nullptr, opacity = update.logit_opacities.value != nullptr;
  for (size_t at = 0; at < count; ++at) {
    const size_t source = sources[at];
    Packed<float> value, gradient;
    Packed<Moment> first, second;
    for (const Part& part : parts) {
      value.take(part.array.value, source, part.columns, part.at);
      first.take(part.array.first, source, part.columns, part.at);
      second.take(part.array.second, source, part.columns, part.at);
    }
    if (geometry) {
      gradient.take(means, at, 3, kMean);
      gradient.take(quats, at, 4, kQuat);
      for (int axis = 0; axis < 3; ++axis) {
        gradient.lane[kScale + axis] = scales[3 * at + axis] * update.scales[3 * source + axis];
      }
    }
    if (opacity) {
      const float now = update.opacities[source];
      gradient.lane[kOpacity] = opacities[at] * now * (1.0f - now);
    }
    Vec m = load_moment(first.lane), v = load_moment(second.lane);
    const Vec moved = adam.step(load(value.lane), m, v, load(gradient.lane), load(rates.lane));
    store(value.lane, moved);
    store_moment(first.lane, m);
    store_moment(second.lane, v);
    for (const Part& part : parts) {
      value.give(part.array.value, source, part.columns, part.at);
      first.give(part.array.first, source, part.columns, part.at);
      second.give(part.array.second, source, part.columns, part.at);
    }
    if (geometry) {
      Packed<float> grown;
      store(grown.lane, exponential(moved));
      grown.give(update.scales, source, 3, kScale);
    }
    if (opacity) {
      Packed<float> seen;
      store(seen.lane, sigmoid(moved));
      seen.give(update.opacities, source, 1, kOpacity);
    }
  }
}

void update_shapes(const ShapeUpdate& update, const AdamTerms& terms, const uint32_t* sources, size_t count,
                   const float* means, const float* quats, const float* scales, const float* opacities) {
  const auto chosen = terms.half_moments ? update_shapes_with<uint16_t> : update_shapes_with<float>;
  chosen(update, Adam(terms), sources, count, means, quats, scales, opacities);
}

template <class Function>
RF_INLINE void each_float(const float* from, size_t count, float* to, Function function) {
  size_t at = 0;
  for (; at + kLanes <= count; at += kLanes) store(to + at, function(load(from + at)));
  if (at == count) return;
  Packed<float> rest;
  std::memcpy(rest.lane, from + at, (count - at) * sizeof(float));
  store(rest.lane, function(load(rest.lane)));
  std::memcpy(to + at, rest.lane, (count - at) * sizeof(float));
}

void exponentials(const float* from, size_t count, float* to) {
  each_float(from, count, to, [](Vec x) { return exponential(x); });
}

void sigmoids(const float* from, size_t count, float* to) {
  each_float(from, count, to, [](Vec x) { return sigmoid(x); });
}

}  // namespace
