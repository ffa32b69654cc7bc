// Adam for the harmonics of Gaussians that a view drew, a row of one Gaussian at a time, in the trainer's order.
#pragma once

#include "core/vector.hpp"
#include "splats/kernels_shade.hpp"
#include "splats/training_kernels.hpp"

namespace {

using namespace rf3dgs;

typedef uint16_t HalfVec __attribute__((vector_size(32)));

// Moments as floats, or as the upper halves of floats, rounded to the nearest.
RF_INLINE Vec load_moment(const float* from) { return load(from); }
RF_INLINE Vec load_moment(const uint16_t* from) {
  alignas(64) uint32_t bits[kLanes];
  for (int lane = 0; lane < kLanes; ++lane) bits[lane] = static_cast<uint32_t>(from[lane]) << 16;
  Vec result;
  std::memcpy(&result, bits, sizeof(result));
  return result;
}
RF_INLINE void store_moment(float* to, const Vec& value) { store(to, value); }
RF_INLINE void store_moment(uint16_t* to, const Vec& value) {
  alignas(64) uint32_t bits[kLanes];
  std::memcpy(bits, &value, sizeof(value));
  for (int lane = 0; lane < kLanes; ++lane) {
    to[lane] = static_cast<uint16_t>((bits[lane] + 0x7fffu + (bits[lane] >> 16 & 1u)) >> 16);
  }
}

struct Adam {
  float beta1, beta2, unbias, least;
  RF_INLINE explicit Adam(const AdamTerms& terms)
      : beta1(terms.beta1), beta2(terms.beta2), unbias(terms.unbias),
        least(__builtin_fmaxf(terms.eps * terms.eps, 1.2e-38f)) {}

  // The parameter after a step; the moments are moved in place.
  RF_INLINE Vec step(Vec value, Vec& first, Vec& second, Vec gradient, Vec rate) const {
    first = beta1 * first + (1.0f - beta1) * gradient;
    second = beta2 * second + (1.0f - beta2) * (gradient * gradient);
    return mul_from(rate * first, inverse_sqrt(max_vec(second * unbias, splat_vec(least))), value);
  }
};

// One step for `count` <= 16 floats.
template <class Moment>
RF_INLINE void adam_span(const Adam& adam, int count, float* value, Moment* first, Moment* second, Vec gradient, Vec rate) {
  if (count == kLanes) {
    Vec m = load_moment(first), v = load_moment(second);
    store(value, adam.step(load(value), m, v, gradient, rate));
    store_moment(first, m);
    store_moment(second, v);
    return;
  }
  alignas(64) float values[kLanes] = {};
  alignas(64) Moment firsts[kLanes] = {}, seconds[kLanes] = {};
  std::memcpy(values, value, count * sizeof(float));
  std::memcpy(firsts, first, count * sizeof(Moment));
  std::memcpy(seconds, second, count * sizeof(Moment));
  adam_span(adam, kLanes, values, firsts, seconds, gradient, rate);
  std::memcpy(value, values, count * sizeof(float));
  std::memcpy(first, firsts, count * sizeof(Moment));
  std::memcpy(second, seconds, count * sizeof(Moment));
}

// The rows of one Gaussian: parameters and moments.
template <class Moment>
struct AdamRow {
  float* value;
  Moment* first;
  Moment* second;

  RF_INLINE AdamRow(const Trained& array, size_t place)
      : value(array.value + place), first(static_cast<Moment*>(array.first) + place),
        second(static_cast<Moment*>(array.second) + place) {}
  RF_INLINE void ask_for(int floats) const {
    constexpr int kLine = 64 / sizeof(float), kMomentLine = 64 / sizeof(Moment);
    for (int at = 0; at < floats; at += kLine) __builtin_prefetch(value + at, 1);
    for (int at = 0; at < floats; at += kMomentLine) __builtin_prefetch(first + at, 1);
    for (int at = 0; at < floats; at += kMomentLine) __builtin_prefetch(second + at, 1);
  }
};

// What the mean square of the coefficients above the first adds to the gradient of `floats` <= 16 of them in rows of L;
// their squares are added to `square`.
template <int L>
RF_INLINE Vec shrinking(const float* value, int floats, float shrink, Vec& square) {
  alignas(64) float bands[kLanes];
  store(bands, load_first(value, floats));
  for (int at = 0; at < floats; at += L) bands[at] = 0.0f;
  const Vec above = load(bands);
  square += above * above;
  return shrink * above;
}

template <int L, class Moment>
double update_harmonics_of(const Shading& shading, const HarmonicsUpdate& update, const Adam& adam,
                           const uint32_t* sources, size_t count, const float* values, const float* gradient) {
  constexpr size_t kAhead = 3;  // how early memory is asked for
  const int channels = shading.channels, width = shading.width(), row = channels * L;
  double squares = 0.0;
  for (size_t start = 0; start < count; start += kLanes) {
    const int lanes = static_cast<int>(count - start < kLanes ? count - start : kLanes);
    const uint32_t* mine = sources + start;
    alignas(64) float rows[kLanes][kLanes];
    basis_rows(rays_of(shading, mine, lanes), shading.bases, L, rows);
    Vec square = {};
    for (int lane = 0; lane < lanes; ++lane) {
      const float* of = gradient + (start + lane) * width;
      const float* value = values + (start + lane) * width;
      const AdamRow<Moment> at(update.sh, static_cast<size_t>(mine[lane]) * row);
      if (start + lane + kAhead < count) {
        AdamRow<Moment>(update.sh, static_cast<size_t>(mine[lane + kAhead]) * row).ask_for(row);
      }
      if constexpr (L == kLanes) {
        const Vec basis = load(rows[lane]);
        for (int channel = 0, first = 0; channel < channels; ++channel, first += L) {
          const bool stopped = shading.clamp && __builtin_signbit(value[channel]);
          Vec part = (stopped ? 0.0f : of[channel]) * basis;
          if (update.shrink > 0.0f) part += shrinking<L>(at.value + first, L, update.shrink, square);
          const Vec rate = load(update.rates + first);
          adam_span(adam, L, at.value + first, at.first + first, at.second + first, part, rate);
        }
      } else {
        for (int first = 0; first < row; first += kLanes) {
          const int floats = row - first < kLanes ? row - first : kLanes;
          alignas(64) float parts[kLanes] = {}, rates[kLanes] = {};
          for (int i = 0; i < floats; ++i) {
            const int channel = (first + i) / L;
            const bool stopped = shading.clamp && __builtin_signbit(value[channel]);
            parts[i] = stopped ? 0.0f : of[channel] * rows[lane][(first + i) % L];
          }
          Vec part = load(parts);
          if (update.shrink > 0.0f) part += shrinking<L>(at.value + first, floats, update.shrink, square);
          std::memcpy(rates, update.rates + first, floats * sizeof(float));
          adam_span(adam, floats, at.value + first, at.first + first, at.second + first, part, load(rates));
        }
      }
    }
    squares += sum_of(square);
  }
  return squares;
}

template <class Moment>
double update_harmonics_with(const Shading& shading, const HarmonicsUpdate& update, const Adam& adam,
                             const uint32_t* sources, size_t count, const float* values, const float* gradient) {
  const auto chosen = [&] {
    switch (shading.lanes) {
      case 1: return update_harmonics_of<1, Moment>;
      case 4: return update_harmonics_of<4, Moment>;
      default: return update_harmonics_of<16, Moment>;
    }
  }();
  return chosen(shading, update, adam, sources, count, values, gradient);
}

double update_harmonics(const Shading& shading, const HarmonicsUpdate& update, const AdamTerms& terms,
                        const uint32_t* sources, size_t count, const float* values, const float* gradient) {
  const auto chosen = terms.half_moments ? update_harmonics_with<uint16_t> : update_harmonics_with<float>;
  return chosen(shading, update, Adam(terms), sources, count, values, gradient);
}

}  // namespace
