// Lists for every tile the splats that reach it.
#pragma once

#include "splats/scene.hpp"

namespace rf3dgs {

// Finds the tiles that the splats of a chunk reach; counts them in the chunk's row of `tile_counts` and writes how many
// each splat has to `slots` of the next.
void find_tiles(Scene& scene, int chunk, const Extent* extents);

// Once all chunks have been found: the lists of all tiles, not yet in order.
void list_tiles(Scene& scene, int threads);

// Brings a tile's list into the order of depth, equal depths into the order of the Gaussians.
void sort_by_depth(Entry* entries, size_t count);

}  // namespace rf3dgs
