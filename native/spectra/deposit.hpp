// Puts paths on the nodes of a fine sphere, each on the four around it. src/rf3dgs/spectra/synthesis.py is the
// specification.
#pragma once

#include <cstddef>

namespace rf3dgs {

constexpr int kDepositChannels = 5;

// Per path: direction of arrival in the device's frame [3], gain, delay, direction of departure [3].
struct ArrivingPaths {
  const float* directions;
  const float* gain;
  const float* delay;
  const float* departures;
};

// Writes total [5, rows, columns]: gain, gain x delay, gain x departure. Node (i, j) lies at zenith (i + 1/2) pi / rows
// and azimuth pi - (j + fold / 2) 2 pi / columns. The bits do not depend on `threads`.
void deposit_paths(const ArrivingPaths& paths, size_t count, int rows, int columns, int fold, double* total, int threads);

}  // namespace rf3dgs
