// The least work that shows how fast a machine can multiply and add and how fast it can read and change memory.
#pragma once

#include <cstddef>

#include "core/floor.hpp"
#include "core/vector.hpp"

namespace {

// Chains of dependent multiply-adds that fill, but do not overflow, the registers of the instruction set.
#if defined(__AVX512F__)
constexpr int kChains = 12;
#elif defined(__AVX2__)
constexpr int kChains = 6;
#else
constexpr int kChains = 3;
#endif

RF_INLINE void add_chains(const Vec* chain, float* sink) {
  Vec total = chain[0];
  for (int at = 1; at < kChains; ++at) total += chain[at];
  *sink += sum_of(total);
}

size_t multiply_adds(size_t rounds, float* sink) {
  const Vec factor = splat_vec(1.0f - 1e-7f * (*sink != 0.5f)), term = splat_vec(1e-7f);
  Vec chain[kChains];
  for (int at = 0; at < kChains; ++at) chain[at] = splat_vec(static_cast<float>(at));
  for (size_t round = 0; round < rounds; ++round) {
    for (int at = 0; at < kChains; ++at) chain[at] = chain[at] * factor + term;
  }
  add_chains(chain, sink);
  return rounds * kChains;
}

void read_all(const float* from, size_t count, float* sink) {
  Vec chain[kChains] = {};
  size_t at = 0;
  for (; at + kChains * kLanes <= count; at += kChains * kLanes) {
    for (int part = 0; part < kChains; ++part) chain[part] += load(from + at + part * kLanes);
  }
  add_chains(chain, sink);
}

void change_all(float* values, size_t count) {
  for (size_t at = 0; at + kLanes <= count; at += kLanes) store(values + at, load(values + at) * 0.5f);
}

}  // namespace

#define RF3DGS_DEFINE_FLOOR(function)                                           \
  namespace rf3dgs {                                                            \
  const FloorKernels& function() {                                              \
    static constexpr FloorKernels table = {::multiply_adds, ::read_all, ::change_all}; \
    return table;                                                               \
  }                                                                             \
  }
