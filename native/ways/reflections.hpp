// Reflections: what planes take from the power of ways. src/rf3dgs/field/reflections.py is the specification.
#pragma once

#include <cstddef>
#include <cstdint>

namespace rf3dgs {

constexpr int kRipple = 81;  // cosines from 0 to 1

// P planes and M marks, as field.reflections.Reflections has them.
struct ReflectionTable {
  const double* laws;      // [P, 3]
  const double* ripple;    // [P, kRipple] [dB]
  const double* marks;     // [M, 3] sorted by plane, and there by x + y + z [m]
  const double* along;     // [M] x + y + z of them
  const double* level_db;  // [M]
  const int64_t* start;    // [P + 1] first mark of each plane
  double width;            // m
};

// The sum [count] of 10 log10 Gamma over reflections of ways at planes [count, 3], -1 for none, at `cosine` [count, 3]
// of incidence, in points [count, 3, 3] [m]. The bits do not depend on `threads`.
void reflect(const ReflectionTable& table, const int64_t* planes, const double* cosine, const double* points,
             size_t count, int threads, double* sum_db);

}  // namespace rf3dgs
