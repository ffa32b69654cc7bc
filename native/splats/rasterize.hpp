// The rasterizer: Gaussians in, picture out, and back.
//
// Forward: project chunks of Gaussians and keep what is visible, ask the caller for the values of these, sort them
// by depth (ties by index), list for every 16x16 tile the splats that reach it, blend. Backward: blend once more per
// tile into a row of gradients per list entry, add these per Gaussian in the order of the tiles, take them back
// through the projection and hand them to the caller. Only the lists are in depth order: the splats and all that is
// kept for them stay in the order of the Gaussians, so that memory is read as it lies. Every sum has one order and
// every chunk one place, so results do not depend on the number of threads.
#pragma once

#include <functional>
#include <memory>

#include "splats/scene.hpp"

namespace rf3dgs {

// Writes the values [end - begin, channels] of visible splats at places begin..end (see SceneMemory: every place is below
// the number of Gaussians); `sources` are their indices among the caller's Gaussians, both pointers belong to `begin`.
// Called in parallel with ranges that do not overlap. A splat whose values are not finite is not drawn: it keeps its
// place, reaches no pixel and has a radius of zero.
using ValuesOf = std::function<void(size_t begin, size_t end, const uint32_t* sources, float* values)>;

// Takes the gradients of visible splats at places begin..end: of their values [., channels], of opacity [.] and of
// geometry (null unless it was asked for). All pointers belong to `begin`. Called in parallel, once for every visible
// splat; the ranges do not depend on the number of threads.
using TakeGradients = std::function<void(size_t begin, size_t end, const uint32_t* sources, const float* values_gradient,
                                         const float* opacity_gradient, const GeometryRows* geometry)>;

// Draws `count` Gaussians into `picture` [row, col, channel] and `weight` [row, col]; `radii` [gaussian] are pixels (zero
// where not drawn). `gate` is how far behind the depth of half transmittance Gaussians count [m], infinite for no gate.
// `max_weight` [gaussian], unless null, keeps the larger of what it holds and the Gaussian's largest weight alpha T over
// the pixels of this picture.
std::unique_ptr<Scene> rasterize(const View& view, size_t count, const Geometry& geometry, int channels,
                                 const ValuesOf& values_of, const float* background, float gate, int threads,
                                 float* picture, float* weight, float* radii, float* max_weight = nullptr);

enum class Which { appearance, everything };  // values and opacities; geometry as well

// `picture` and `weight` are what `rasterize` wrote; `weight_gradient` may be null.
void rasterize_backward(Scene& scene, const Geometry& geometry, const float* picture, const float* weight,
                        const float* picture_gradient, const float* weight_gradient, Which which, int threads,
                        const TakeGradients& take);

}  // namespace rf3dgs
