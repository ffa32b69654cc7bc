#include "spectra/deposit.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "core/buffer.hpp"
#include "core/thread_pool.hpp"

namespace rf3dgs {
namespace {

constexpr size_t kChunk = 16384;  // paths
constexpr int kBand = 8;          // rows of nodes that one index of the loop owns
constexpr double kPi = 3.14159265358979323846;

// Where a path falls: the node above and left of it, which may lie one row above the first.
struct Fallen {
  int32_t row, column;
  float down, right;
};

struct Value {
  Fallen at;
  float gain, delay, departure[3];
};

struct Memory {
  Buffer<Fallen> fallen;
  Buffer<Value> sorted;
  Buffer<double> sums;
};

Fallen fall(const float* direction, int rows, int columns, int fold) {
  const float zenith = std::atan2(std::sqrt(direction[0] * direction[0] + direction[1] * direction[1]), direction[2]);
  const float azimuth = std::atan2(direction[1], direction[0]);
  const double y = zenith * (rows / kPi) - 0.5, x = (kPi - azimuth) * (columns / (2.0 * kPi)) - 0.5 * fold;
  const double row = std::floor(y), column = std::floor(x);
  if (!(row >= -1.0 && row < rows && std::abs(column) <= 2.0 * columns)) return {0, 0, 0.0f, 0.0f};  // not a direction
  return {static_cast<int32_t>(row), (static_cast<int32_t>(column) % columns + columns) % columns,
          static_cast<float>(y - row), static_cast<float>(x - column)};
}

}  // namespace

void deposit_paths(const ArrivingPaths& paths, size_t count, int rows, int columns, int fold, double* total,
                   int threads) {
  const int chunks = static_cast<int>((count + kChunk - 1) / kChunk), bands = (rows + kBand) / kBand;
  const auto band_of = [](int row) { return (row + 1) / kBand; };
  // First where each path falls and how many of a chunk fall into each band, then the paths band by band.
  Recycled<Memory> memory;
  Fallen* const fallen = memory->fallen.resize(count);
  std::vector<size_t> start(static_cast<size_t>(bands) * chunks + 1, 0);
  const auto end_of = [&](int chunk) { return std::min(count, (static_cast<size_t>(chunk) + 1) * kChunk); };
  parallel_for(chunks, threads, [&](int chunk) {
    for (size_t path = chunk * kChunk; path < end_of(chunk); ++path) {
      if (!(paths.gain[path] > 0.0f)) continue;
      fallen[path] = fall(paths.directions + 3 * path, rows, columns, fold);
      ++start[static_cast<size_t>(band_of(fallen[path].row)) * chunks + chunk + 1];
    }
  });
  for (size_t at = 1; at < start.size(); ++at) start[at] += start[at - 1];
  Value* const sorted = memory->sorted.resize(start.back());
  parallel_for(chunks, threads, [&](int chunk) {
    std::vector<size_t> next(bands);
    for (int band = 0; band < bands; ++band) next[band] = start[static_cast<size_t>(band) * chunks + chunk];
    for (size_t path = chunk * kChunk; path < end_of(chunk); ++path) {
      if (!(paths.gain[path] > 0.0f)) continue;
      const float* departure = paths.departures + 3 * path;
      sorted[next[band_of(fallen[path].row)]++] = {
          fallen[path], paths.gain[path], paths.delay[path], {departure[0], departure[1], departure[2]}};
    }
  });
  // A band of rows -1 + 8 b ... is kept with the row below it, which the next band adds to.
  const size_t line = static_cast<size_t>(columns) * kDepositChannels, size = (kBand + 1) * line;
  double* const sums = memory->sums.resize(static_cast<size_t>(bands) * size);
  parallel_for(bands, threads, [&](int band) {
    double* const sum = sums + band * size;
    std::fill_n(sum, size, 0.0);
    const size_t end = start[static_cast<size_t>(band + 1) * chunks];
    for (size_t index = start[static_cast<size_t>(band) * chunks]; index < end; ++index) {
      const Value& value = sorted[index];
      const double gain = value.gain, down = value.at.down, right = value.at.right;
      const double channel[kDepositChannels] = {gain, gain * value.delay, gain * value.departure[0],
                                                gain * value.departure[1], gain * value.departure[2]};
      const int row = value.at.row + 1 - band * kBand;
      const int left_column = value.at.column, right_column = left_column + 1 == columns ? 0 : left_column + 1;
      for (int below = 0; below < 2; ++below) {
        const double share = below == 1 ? down : 1.0 - down;
        double* const left = sum + (row + below) * line + static_cast<size_t>(left_column) * kDepositChannels;
        double* const beside = sum + (row + below) * line + static_cast<size_t>(right_column) * kDepositChannels;
        for (int at = 0; at < kDepositChannels; ++at) {
          left[at] += share * (1.0 - right) * channel[at];
          beside[at] += share * right * channel[at];
        }
      }
    }
  });
  // Rows above the first and below the last fall onto these.
  parallel_for(rows, threads, [&](int row) {
    const int band = band_of(row), inside = row + 1 - band * kBand;
    const double* parts[3] = {sums + band * size + inside * line, nullptr, nullptr};
    if (inside == 0 && band > 0) parts[1] = sums + (band - 1) * size + kBand * line;
    if (row == 0) parts[2] = sums;
    if (row == rows - 1) parts[2] = sums + band * size + (inside + 1) * line;
    for (int channel = 0; channel < kDepositChannels; ++channel) {
      double* const to = total + (static_cast<size_t>(channel) * rows + row) * columns;
      for (int column = 0; column < columns; ++column) {
        const size_t at = static_cast<size_t>(column) * kDepositChannels + channel;
        double value = parts[0][at];
        if (parts[1] != nullptr) value += parts[1][at];
        if (parts[2] != nullptr) value += parts[2][at];
        to[column] = value;
      }
    }
  });
}

}  // namespace rf3dgs
