#include "spectra/responses.hpp"

#include <algorithm>
#include <cstring>
#include <string>
#include <vector>

#include "core/thread_pool.hpp"
#include "splats/kernels.hpp"

namespace rf3dgs {
namespace {

constexpr int kBlock = 16;        // cells that share their lines
constexpr size_t kPiece = 16384;  // paths of a block that one index of the loop takes at most

const SpectraKernels& spectra_kernels() {
#if defined(RF3DGS_X86)
  const std::string name = kernels().name;
  if (name == "avx512") return avx512_spectra();
  if (name == "avx2") return avx2_spectra();
#endif
  return portable_spectra();
}

struct Piece {
  int first_cell;
  size_t begin, end;  // of the sorted paths
};

}  // namespace

void spread_responses(const PathWaves& waves, size_t count, int cells, double* total, int threads) {
  const auto cell_of = [&](size_t path) {
    const double place = waves.place[path];
    return place >= 0.0 && place < cells ? static_cast<int>(place) : place >= cells ? cells - 1 : 0;
  };
  // Paths in the order of their cells, equal cells in the order they came.
  std::vector<size_t> start(cells + 1, 0);
  for (size_t path = 0; path < count; ++path) ++start[cell_of(path) + 1];
  for (int cell = 0; cell < cells; ++cell) start[cell + 1] += start[cell];
  std::vector<uint32_t> order(count);
  std::vector<size_t> next(start.begin(), start.end() - 1);
  for (size_t path = 0; path < count; ++path) order[next[cell_of(path)]++] = static_cast<uint32_t>(path);

  std::vector<Piece> pieces;
  for (int cell = 0; cell < cells; cell += kBlock) {
    const size_t end = start[std::min(cell + kBlock, cells)];
    for (size_t at = start[cell]; at < end; at += kPiece) pieces.push_back({cell, at, std::min(end, at + kPiece)});
  }
  const int elements = waves.rows * waves.cols, line = spread_line(elements), padded = padded_elements(elements);
  const size_t lines = kBlock + kSpreadWidth - 1;
  std::vector<std::vector<double>> sums(pieces.size());
  parallel_for(static_cast<int>(pieces.size()), threads, [&](int index) {
    const Piece& piece = pieces[index];
    std::vector<double>& sum = sums[index];
    sum.assign(lines * line, 0.0);
    std::vector<double> scratch(spread_scratch(elements, waves.rows, waves.cols));
    size_t at = piece.begin;
    for (int cell = piece.first_cell; at < piece.end; ++cell) {
      const size_t end = std::min(piece.end, start[cell + 1]);
      while (at < end) {
        const int group = static_cast<int>(std::min<size_t>(kSpreadGroup, end - at));
        spectra_kernels().spread(waves, order.data() + at, group, cell,
                                 sum.data() + static_cast<size_t>(cell - piece.first_cell) * line, scratch.data());
        at += group;
      }
    }
  });
  // The lines of all pieces, one element after the other, always in the order of the pieces.
  parallel_for(elements, threads, [&](int element) {
    double* const real = total + static_cast<size_t>(element) * cells;
    double* const imaginary = real + static_cast<size_t>(elements) * cells;
    for (size_t index = 0; index < pieces.size(); ++index) {
      for (size_t at = 0; at < lines; ++at) {
        int cell = (pieces[index].first_cell + static_cast<int>(at) - kSpreadAhead) % cells;
        if (cell < 0) cell += cells;
        real[cell] += sums[index][at * line + element];
        imaginary[cell] += sums[index][at * line + padded + element];
      }
    }
  });
}

}  // namespace rf3dgs
