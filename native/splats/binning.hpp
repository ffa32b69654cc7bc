// Lists for every tile the splats that reach it, from front to back.
#pragma once

#include "splats/scene.hpp"

namespace rf3dgs {

// Finds the tiles that the splats of a chunk reach.
void find_tiles(Scene& scene, int chunk);

// Once all chunks have been found: the lists of all tiles, ordered by depth, equal depths by the order of the
// Gaussians.
void list_tiles(Scene& scene, int threads);

}  // namespace rf3dgs
