// From harmonics to the values a viewer sees, for the Gaussians in view only.
//
// Directions and basis are computed for sixteen Gaussians at once; the basis is then turned on its side, so that the
// coefficients of one Gaussian, which lie together, meet theirs in one vector.
#pragma once

#include "core/vector.hpp"
#include "splats/kernels_harmonics.hpp"
#include "splats/training_kernels.hpp"

namespace {

using namespace rf3dgs;

// Sixteen Gaussians as seen by a viewer: unit vectors towards them and their distances.
struct Rays {
  Vec x, y, z, range;
};

RF_INLINE Rays rays_of(const Shading& shading, const uint32_t* sources, int lanes) {
  alignas(64) float part[3][kLanes];
  for (int lane = 0; lane < kLanes; ++lane) {
    const float* mean = shading.means + 3 * static_cast<size_t>(sources[lane < lanes ? lane : 0]);
    for (int axis = 0; axis < 3; ++axis) part[axis][lane] = mean[axis];
  }
  Rays rays;
  rays.x = load(part[0]) - shading.centre[0];
  rays.y = load(part[1]) - shading.centre[1];
  rays.z = load(part[2]) - shading.centre[2];
  rays.range = sqrt_vec(rays.x * rays.x + rays.y * rays.y + rays.z * rays.z + 1e-24f);
  const Vec inverse = 1.0f / rays.range;
  rays.x = rays.x * inverse;
  rays.y = rays.y * inverse;
  rays.z = rays.z * inverse;
  return rays;
}

// Four vectors of four lanes, on their side.
RF_INLINE void transpose_four(const float* from, float* to) {
  Four row[4];
  for (int at = 0; at < 4; ++at) std::memcpy(&row[at], from + at * kLanes, sizeof(Four));
  const Four a = __builtin_shufflevector(row[0], row[1], 0, 4, 1, 5), b = __builtin_shufflevector(row[2], row[3], 0, 4, 1, 5);
  const Four c = __builtin_shufflevector(row[0], row[1], 2, 6, 3, 7), d = __builtin_shufflevector(row[2], row[3], 2, 6, 3, 7);
  const Four turned[4] = {__builtin_shufflevector(a, b, 0, 1, 4, 5), __builtin_shufflevector(a, b, 2, 3, 6, 7),
                          __builtin_shufflevector(c, d, 0, 1, 4, 5), __builtin_shufflevector(c, d, 2, 3, 6, 7)};
  for (int at = 0; at < 4; ++at) std::memcpy(to + at * kLanes, &turned[at], sizeof(Four));
}

// The basis [Gaussian, 16] at sixteen rays, zero from `bases` on.
RF_INLINE void basis_rows(const Rays& rays, int bases, int lanes, float (*rows)[kLanes]) {
  alignas(64) float columns[16][kLanes];
  Vec basis[16];
  basis_at(rays.x, rays.y, rays.z, bases, basis);
  for (int k = 0; k < 16; ++k) store(columns[k], k < bases ? basis[k] : Vec{});
  for (int k = 0; k < lanes; k += 4) {
    for (int lane = 0; lane < kLanes; lane += 4) transpose_four(&columns[k][lane], &rows[lane][k]);
  }
}

// Writes what is not harmonics: constant channels and depth.
RF_INLINE void shade_others(const Shading& shading, const uint32_t* sources, int lanes, const Rays& rays, float* values) {
  const int width = shading.width();
  const Vec& range = rays.range;
  for (int lane = 0; lane < lanes; ++lane) {
    float* to = values + static_cast<size_t>(lane) * width + shading.channels;
    if (shading.extra != nullptr) {
      const size_t row = shading.order == nullptr ? sources[lane] : shading.order[sources[lane]];
      std::memcpy(to, shading.extra + row * shading.extras, shading.extras * sizeof(float));
    }
    if (!shading.depth) continue;
    const float* mean = shading.means + 3 * static_cast<size_t>(sources[lane]);
    const float* axis = shading.axis;
    to[shading.extras] =
        shading.range ? range[lane] : axis[0] * mean[0] + axis[1] * mean[1] + axis[2] * mean[2] + axis[3];
  }
}

// Adds what belongs to a sum of harmonics and cuts it.
RF_INLINE float finished_value(const Shading& shading, float sum, size_t source, int channel, float range) {
  float value = sum + shading.offset;
  if (shading.base != nullptr) value += shading.base[source * shading.channels + channel];
  if (shading.along != nullptr) value += shading.along[channel] * range;
  return shading.clamp && value < 0.0f ? -0.0f : value;
}

// Asks for the coefficients of sixteen Gaussians, which lie wherever they lie, before they are read.
RF_INLINE void ask_for_rows(const float* coefficients, const uint32_t* sources, int lanes, size_t floats) {
  constexpr size_t kLine = 64 / sizeof(float);
  for (int lane = 0; lane < lanes; ++lane) {
    for (size_t at = 0; at < floats; at += kLine) __builtin_prefetch(coefficients + sources[lane] * floats + at);
  }
}

template <int L>
void shade_rows(const Shading& shading, const uint32_t* sources, size_t count, float* values) {
  const int channels = shading.channels, width = shading.width();
  for (size_t start = 0; start < count; start += kLanes) {
    const int lanes = static_cast<int>(count - start < kLanes ? count - start : kLanes);
    const uint32_t* mine = sources + start;
    float* to = values + start * width;
    const Rays rays = rays_of(shading, mine, lanes);
    if (start + kLanes < count) {
      const int next = static_cast<int>(count - start - kLanes < kLanes ? count - start - kLanes : kLanes);
      ask_for_rows(shading.coefficients, mine + kLanes, next, static_cast<size_t>(channels) * L);
    }
    alignas(64) float rows[kLanes][kLanes];
    basis_rows(rays, shading.bases, L, rows);
    const Vec& range = rays.range;
    for (int channel = 0; channel < channels; ++channel) {
      alignas(64) float sums[kLanes];
      if constexpr (L == 16) {
        Vec products[kLanes];
        for (int lane = 0; lane < kLanes; ++lane) {
          const size_t row = static_cast<size_t>(mine[lane < lanes ? lane : 0]) * channels + channel;
          products[lane] = load(rows[lane]) * load(shading.coefficients + row * L);
        }
        sums_of<kLanes>(products, sums);
      } else {
        for (int lane = 0; lane < lanes; ++lane) {
          const float* from = shading.coefficients + (static_cast<size_t>(mine[lane]) * channels + channel) * L;
          sums[lane] = 0.0f;
          for (int k = 0; k < L; ++k) sums[lane] += rows[lane][k] * from[k];
        }
      }
      for (int lane = 0; lane < lanes; ++lane) {
        to[lane * width + channel] = finished_value(shading, sums[lane], mine[lane], channel, range[lane]);
      }
    }
    shade_others(shading, mine, lanes, rays, to);
  }
}

void shade(const Shading& shading, const uint32_t* sources, size_t count, float* values) {
  switch (shading.lanes) {
    case 1: return shade_rows<1>(shading, sources, count, values);
    case 4: return shade_rows<4>(shading, sources, count, values);
    default: return shade_rows<16>(shading, sources, count, values);
  }
}

// The same for coefficients [gaussian, bases, channels], as they are stored outside a trainer.
void shade_plain(const Shading& shading, const uint32_t* sources, size_t count, float* values) {
  const int channels = shading.channels, bases = shading.bases, width = shading.width();
  for (size_t start = 0; start < count; start += kLanes) {
    const int lanes = static_cast<int>(count - start < kLanes ? count - start : kLanes);
    const uint32_t* mine = sources + start;
    float* to = values + start * width;
    const Rays rays = rays_of(shading, mine, lanes);
    Vec basis[16];
    alignas(64) float columns[16][kLanes];
    basis_at(rays.x, rays.y, rays.z, bases, basis);
    for (int k = 0; k < bases; ++k) store(columns[k], basis[k]);
    const Vec& range = rays.range;
    for (int lane = 0; lane < lanes; ++lane) {
      const float* from = shading.coefficients + static_cast<size_t>(mine[lane]) * bases * channels;
      float* value = to + lane * width;
      if (channels == 3) {
        Four sum = {};
        for (int k = 0; k < bases - 1; ++k) sum += columns[k][lane] * load_channels<3>(from + 3 * k, false);
        sum += columns[bases - 1][lane] * load_channels<3>(from + 3 * (bases - 1), true);
        for (int channel = 0; channel < 3; ++channel) value[channel] = sum[channel];
      } else {
        for (int channel = 0; channel < channels; ++channel) {
          value[channel] = 0.0f;
          for (int k = 0; k < bases; ++k) value[channel] += columns[k][lane] * from[k * channels + channel];
        }
      }
      for (int channel = 0; channel < channels; ++channel) {
        value[channel] = finished_value(shading, value[channel], mine[lane], channel, range[lane]);
      }
    }
    shade_others(shading, mine, lanes, rays, to);
  }
}

}  // namespace
