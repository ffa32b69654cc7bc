// The inner loop of spreading, compiled once for each instruction set.
#pragma once

#include <cmath>
#include <cstring>

#include "spectra/responses.hpp"

namespace {

using namespace rf3dgs;

#if defined(__AVX512F__)
constexpr int kDoubles = 8;
#elif defined(__AVX2__)
constexpr int kDoubles = 4;
#else
constexpr int kDoubles = 2;
#endif
typedef double Doubles __attribute__((vector_size(kDoubles * 8), aligned(8), may_alias));

constexpr int kHalf = kSpreadWidth / 2;  // lines that are kept in registers, for two vectors each

// Phasors e^{j phase (i - (count - 1) / 2)}: those of positive exponent by repeated multiplication, the others their
// conjugates.
inline void centred_phasors(double phase, int count, double* real, double* imaginary) {
  const double half_real = std::cos(0.5 * phase), half_imaginary = std::sin(0.5 * phase);
  const double step_real = half_real * half_real - half_imaginary * half_imaginary;
  const double step_imaginary = 2.0 * half_real * half_imaginary;
  double x = count % 2 == 1 ? 1.0 : half_real, y = count % 2 == 1 ? 0.0 : half_imaginary;
  for (int at = count / 2; at < count; ++at) {
    real[at] = real[count - 1 - at] = x;
    imaginary[at] = y;
    imaginary[count - 1 - at] = -y;
    const double next = x * step_real - y * step_imaginary;
    y = x * step_imaginary + y * step_real;
    x = next;
  }
  if (count % 2 == 1) imaginary[count / 2] = 0.0;
}

// Weights of the paths in the lines, by Horner's rule for all taps at once.
inline void tap_weights(const double* polynomials, double fraction, double* weights) {
  const double t = 2.0 * fraction - 1.0;
  for (int tap = 0; tap < kSpreadColumns; ++tap) weights[tap] = polynomials[tap];
  for (int term = 1; term < kSpreadTerms; ++term) {
    const double* row = polynomials + term * kSpreadColumns;
    for (int tap = 0; tap < kSpreadColumns; ++tap) weights[tap] = weights[tap] * t + row[tap];
  }
}

void spread(const PathWaves& waves, const uint32_t* paths, int count, double cell, double* lines, double* scratch) {
  const int rows = waves.rows, cols = waves.cols;
  const int padded = padded_elements(rows * cols), line = 2 * padded;
  const int wide_rows = (rows + kDoubles - 1) / kDoubles * kDoubles;
  double* const weights = scratch;
  double* const row_real = weights + kSpreadGroup * kSpreadColumns;
  double* const row_imaginary = row_real + rows + 8;
  double* const col_real = row_imaginary + rows + 8;
  double* const col_imaginary = col_real + cols;
  double* const responses = col_imaginary + cols;
  std::memset(row_real, 0, sizeof(double) * 2 * (rows + 8));
  for (int at = 0; at < count; ++at) {
    const size_t path = paths[at];
    tap_weights(waves.polynomials, waves.place[path] - cell, weights + at * kSpreadColumns);
    centred_phasors(waves.column_phase * waves.directions[3 * path + 1], cols, col_real, col_imaginary);
    centred_phasors(waves.row_phase * waves.directions[3 * path + 2], rows, row_real, row_imaginary);
    const double a = waves.coeff[2 * path], b = waves.coeff[2 * path + 1];
    double* const real = responses + static_cast<size_t>(at) * line;
    // Columns are written in whole vectors; what overhangs is overwritten by what follows it.
    for (int part = 0; part < 2; ++part) {
      for (int col = 0; col < cols; ++col) {
        const double x = a * col_real[col] - b * col_imaginary[col], y = a * col_imaginary[col] + b * col_real[col];
        double* const to = real + part * padded + col * rows;
        for (int row = 0; row < wide_rows; row += kDoubles) {
          const Doubles c = *reinterpret_cast<const Doubles*>(row_real + row);
          const Doubles s = *reinterpret_cast<const Doubles*>(row_imaginary + row);
          *reinterpret_cast<Doubles*>(to + row) = part == 0 ? x * c - y * s : x * s + y * c;
        }
      }
      // Padding beyond the last element would otherwise hold what another array left there.
      for (int at_end = rows * cols; at_end < padded; ++at_end) real[part * padded + at_end] = 0.0;
    }
  }
  for (int at = 0; at < line; at += 2 * kDoubles) {
    for (int first = 0; first < kSpreadWidth; first += kHalf) {
      Doubles sum[kHalf][2];
      for (int tap = 0; tap < kHalf; ++tap) {
        const double* from = lines + static_cast<size_t>(first + tap) * line + at;
        sum[tap][0] = *reinterpret_cast<const Doubles*>(from);
        sum[tap][1] = *reinterpret_cast<const Doubles*>(from + kDoubles);
      }
      for (int path = 0; path < count; ++path) {
        const double* from = responses + static_cast<size_t>(path) * line + at;
        const Doubles left = *reinterpret_cast<const Doubles*>(from);
        const Doubles right = *reinterpret_cast<const Doubles*>(from + kDoubles);
        const double* weight = weights + path * kSpreadColumns + first;
        for (int tap = 0; tap < kHalf; ++tap) {
          sum[tap][0] += weight[tap] * left;
          sum[tap][1] += weight[tap] * right;
        }
      }
      for (int tap = 0; tap < kHalf; ++tap) {
        double* to = lines + static_cast<size_t>(first + tap) * line + at;
        *reinterpret_cast<Doubles*>(to) = sum[tap][0];
        *reinterpret_cast<Doubles*>(to + kDoubles) = sum[tap][1];
      }
    }
  }
}

}  // namespace

#define RF3DGS_DEFINE_SPECTRA(function)                    \
  namespace rf3dgs {                                       \
  const SpectraKernels& function() {                       \
    static constexpr SpectraKernels table = {::spread};    \
    return table;                                          \
  }                                                        \
  }
