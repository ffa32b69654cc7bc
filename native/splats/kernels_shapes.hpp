// Adam for shape and opacity of Gaussians that a view drew, sixteen at a time, and how these are activated.
#pragma once

#include "core/vector.hpp"
#include "splats/kernels_adam.hpp"
#include "splats/training_kernels.hpp"

namespace {

using namespace rf3dgs;

// e^x within the range of floats; NaN becomes the largest.
RF_INLINE Vec exponential(Vec x) { return exp2_vec(min_vec(x * 1.44269504088896341f, splat_vec(127.0f))); }
RF_INLINE Vec sigmoid(Vec x) { return 1.0f / (1.0f + exponential(0.0f - x)); }

// One column of arrays [gaussian, columns], of sixteen Gaussians.
template <class Number>
struct Column {
  alignas(64) Number lane[kLanes];

  RF_INLINE void take(const Number* from, const size_t* rows, int columns) {
    for (int at = 0; at < kLanes; ++at) lane[at] = from[rows[at] * columns];
  }
  RF_INLINE void give(Number* to, const size_t* rows, int lanes, int columns) const {
    for (int at = 0; at < lanes; ++at) to[rows[at] * columns] = lane[at];
  }
};

// Sixteen Gaussians or fewer: their rows among all, and their rows among the gradients.
struct Group {
  size_t rows[kLanes], places[kLanes];
  int lanes;
};

// One step for a column of a parameter; returns its new values.
template <class Moment>
RF_INLINE Vec adam_column(const Adam& adam, const Trained& array, int columns, int column, const Group& group, Vec gradient,
                          float rate) {
  Column<float> value;
  Column<Moment> first, second;
  Moment *const firsts = static_cast<Moment*>(array.first) + column, *const seconds = static_cast<Moment*>(array.second) + column;
  value.take(array.value + column, group.rows, columns);
  first.take(firsts, group.rows, columns);
  second.take(seconds, group.rows, columns);
  Vec m = load_moment(first.lane), v = load_moment(second.lane);
  const Vec moved = adam.step(load(value.lane), m, v, gradient, splat_vec(rate));
  store(value.lane, moved);
  store_moment(first.lane, m);
  store_moment(second.lane, v);
  value.give(array.value + column, group.rows, group.lanes, columns);
  first.give(firsts, group.rows, group.lanes, columns);
  second.give(seconds, group.rows, group.lanes, columns);
  return moved;
}

RF_INLINE Vec column_of(const float* from, const size_t* rows, int columns, int column) {
  Column<float> result;
  result.take(from + column, rows, columns);
  return load(result.lane);
}

template <class Moment>
void update_shapes_with(const ShapeUpdate& update, const Adam& adam, const uint32_t* sources, size_t count,
                        const float* means, const float* quats, const float* scales, const float* opacities) {
  Group group;
  for (size_t start = 0; start < count; start += kLanes) {
    group.lanes = static_cast<int>(count - start < kLanes ? count - start : kLanes);
    for (int lane = 0; lane < kLanes; ++lane) {
      group.places[lane] = start + (lane < group.lanes ? lane : 0);
      group.rows[lane] = sources[group.places[lane]];
    }
    Column<float> active;
    if (update.logit_opacities.value != nullptr) {
      const Vec now = column_of(update.opacities, group.rows, 1, 0);
      const Vec gradient = column_of(opacities, group.places, 1, 0) * now * (1.0f - now);
      const Vec moved = adam_column<Moment>(adam, update.logit_opacities, 1, 0, group, gradient, update.rate_opacity);
      store(active.lane, sigmoid(moved));
      active.give(update.opacities, group.rows, group.lanes, 1);
    }
    if (update.means.value == nullptr) continue;
    for (int axis = 0; axis < 3; ++axis) {
      const Vec gradient = column_of(means, group.places, 3, axis);
      adam_column<Moment>(adam, update.means, 3, axis, group, gradient, update.rate_means);
    }
    for (int part = 0; part < 4; ++part) {
      const Vec gradient = column_of(quats, group.places, 4, part);
      adam_column<Moment>(adam, update.quats, 4, part, group, gradient, update.rate_quats);
    }
    for (int axis = 0; axis < 3; ++axis) {
      const Vec scale = column_of(update.scales, group.rows, 3, axis);
      const Vec gradient = column_of(scales, group.places, 3, axis) * scale;
      const Vec moved = adam_column<Moment>(adam, update.log_scales, 3, axis, group, gradient, update.rate_log_scales);
      store(active.lane, exponential(moved));
      active.give(update.scales + axis, group.rows, group.lanes, 3);
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
  Column<float> rest = {};
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
