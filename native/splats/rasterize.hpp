// The rasterizer: Gaussians in, picture out, and back.
//
// Forward: project, sort by view depth (ties by index), list for every 16x16 tile the splats that reach it, blend.
// Backward: blend once more per tile into a row of gradients per list entry, add these per Gaussian in the order of the
// tiles, take them back through the projection. Only the lists are in depth order: the splats and all that is kept for
// them stay in the order of the Gaussians, so that memory is read as it lies. Every sum has one order, so results do not depend on the
// number of threads.
#pragma once

#include <memory>
#include <vector>

#include "splats/kernels.hpp"

namespace rf3dgs {

// What the backward pass needs of the forward pass.
struct Scene {
  View view;
  size_t gaussians = 0;
  int channels = 0;
  int tiles_x = 0, tiles_y = 0;
  std::vector<Splat> splats;         // the visible ones in the order of the Gaussians
  std::vector<float> values;         // [splat, channel]
  std::vector<Entry> entries;        // tile by tile, front to back
  std::vector<size_t> tile_start;    // [tile + 1]
  std::vector<size_t> places;        // where each splat's entries are, splat by splat, tiles in order
  std::vector<size_t> place_start;   // [splat + 1]
};

std::unique_ptr<Scene> rasterize(const View& view, size_t gaussians, const Parameters& in,
                                 const float* background, int threads, float* picture, float* weight,
                                 float* radii);

// Gradients to be written, [gaussian, ...], zeroed by the caller; null pointers are not computed.
struct Gradients {
  float* values;
  float* opacities;
  float* means;
  float* quats;
  float* scales;
  float* offset;
};

void rasterize_backward(const Scene& scene, const Parameters& in, const float* picture, const float* weight,
                        const float* picture_gradient, const float* weight_gradient, int threads, const Gradients& out);

}  // namespace rf3dgs
