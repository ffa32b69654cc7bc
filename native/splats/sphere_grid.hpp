// What the pixels of the whole sphere look at.
#pragma once

#include "core/buffer.hpp"
#include "splats/kernels.hpp"

namespace rf3dgs {

// The tables of a picture of `width` x `height` pixels in `memory`, whose first use of this size fills them.
struct SphereMemory {
  int width = 0, height = 0;
  Buffer<float> tables;
};
SphereGrid sphere_grid(SphereMemory& memory, int width, int height);

}  // namespace rf3dgs
