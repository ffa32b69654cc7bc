// Lists for every tile the splats that reach it.
#pragma once

#include "splats/scene.hpp"

namespace rf3dgs {

// Finds the tiles that the splats of a chunk reach and counts them in the chunk's row of `tile_counts`.
void find_tiles(Scene& scene, int chunk);

// Once all chunks have been found: the lists of all tiles, not yet in order.
void list_tiles(Scene& scene, int threads);

// Brings a tile's list into `entries`, ordered by depth, equal depths by the order of the Gaussians.
void sort_by_depth(Scene& scene, int tile);

}  // namespace rf3dgs
