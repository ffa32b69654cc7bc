// The order of points along a Morton curve: neighbours in space become neighbours in memory.
#pragma once

#include <cstddef>
#include <cstdint>

namespace rf3dgs {

// The curve runs through the box of `means` [count, 3]; equal places by index, those that are not finite last.
void morton_order(const float* means, size_t count, uint32_t* order);

}  // namespace rf3dgs
