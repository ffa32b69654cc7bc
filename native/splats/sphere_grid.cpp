#include "splats/sphere_grid.hpp"

#include <cmath>

namespace rf3dgs {

SphereGrid sphere_grid(SphereMemory& memory, int width, int height) {
  constexpr int kBlock = 4, kSide = kTileSize / kBlock, kCells = kBlock * kBlock, kRecord = 2 * kCells;
  static_assert(kSide == kBlock, "a tile has as many blocks as a block has pixels");
  constexpr double kPi = 3.14159265358979323846;
  const int tiles_x = (width + kTileSize - 1) / kTileSize, tiles_y = (height + kTileSize - 1) / kTileSize;
  float* const block_column = memory.tables.resize(kRecord * (kSide + 1) * (tiles_x + tiles_y));
  float* const block_row = block_column + kRecord * kSide * tiles_x;
  float* const tile_column = block_row + kRecord * kSide * tiles_y;
  float* const tile_row = tile_column + kRecord * tiles_x;
  if (memory.width == width && memory.height == height) return {block_column, block_row, tile_column, tile_row};
  memory.width = width;
  memory.height = height;
  // Angles of the four columns, or the four rows, of records whose first lies at `step / 2`.
  const auto fill = [](float* to, int records, double step, bool is_row) {
    for (int at = 0; at < records; ++at, to += kRecord) {
      for (int cell = 0; cell < kCells; ++cell) {
        const int place = is_row ? cell / kBlock : cell % kBlock;
        const double angle = (kBlock * at + place + 0.5) * step;
        to[cell] = static_cast<float>(std::sin(angle));
        to[kCells + cell] = static_cast<float>(std::cos(angle));
      }
    }
  };
  const double turn = 2 * kPi / width, tilt = kPi / height;
  fill(block_column, kSide * tiles_x, turn, false);
  fill(block_row, kSide * tiles_y, tilt, true);
  fill(tile_column, tiles_x, kBlock * turn, false);
  fill(tile_row, tiles_y, kBlock * tilt, true);
  return {block_column, block_row, tile_column, tile_row};
}

}  // namespace rf3dgs
