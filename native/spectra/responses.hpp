// Spreads paths over a ring of delay cells, for all elements of a planar array at once: the first half of a non-uniform
// Fourier transform. src/rf3dgs/spectra/responses.py is the specification and does the second half.
#pragma once

#include <cstddef>
#include <cstdint>

namespace rf3dgs {

constexpr int kSpreadWidth = 12;   // cells of a path
constexpr int kSpreadAhead = 5;    // of these before the one that holds it
constexpr int kSpreadTerms = 16;   // of a polynomial
constexpr int kSpreadColumns = 16; // polynomials, those beyond the width zero
constexpr int kSpreadGroup = 32;   // paths of one cell that are spread together

struct PathWaves {
  const double* coeff;        // [path, 2]
  const double* place;        // [path], in cells
  const double* directions;   // [path, 3], device frame
  const double* polynomials;  // [kSpreadTerms, kSpreadColumns], highest power first, of 2 f - 1
  double column_phase;        // radians between columns and between rows for a unit of y and of z
  double row_phase;
  int rows, cols;
};

// Doubles of a line: real parts of all elements and imaginary parts, each in whole vectors.
constexpr int padded_elements(int elements) { return (elements + 7) / 8 * 8; }
constexpr int spread_line(int elements) { return 2 * padded_elements(elements); }
// Doubles that spread() needs to work in.
constexpr size_t spread_scratch(int elements, int rows, int cols) {
  return static_cast<size_t>(kSpreadGroup) * (spread_line(elements) + kSpreadColumns) + 2 * (rows + 8) + 2 * cols + 16;
}

struct SpectraKernels {
  // Adds up to kSpreadGroup paths that lie in the same cell to kSpreadWidth lines.
  void (*spread)(const PathWaves&, const uint32_t* paths, int count, double cell, double* lines, double* scratch);
};

const SpectraKernels& portable_spectra();
#if defined(RF3DGS_X86)
const SpectraKernels& avx2_spectra();
const SpectraKernels& avx512_spectra();
#endif

// Adds the paths to `total` [2 elements, cells]: real parts, then imaginary parts. The bits do not depend on `threads`.
void spread_responses(const PathWaves& waves, size_t count, int cells, double* total, int threads);

}  // namespace rf3dgs
