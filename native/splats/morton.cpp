#include "splats/morton.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>
#include <vector>

namespace rf3dgs {

void morton_order(const float* means, size_t count, uint32_t* order) {
  constexpr int kBits = 16;
  float low[3], high[3];
  std::fill(low, low + 3, std::numeric_limits<float>::max());
  std::fill(high, high + 3, std::numeric_limits<float>::lowest());
  const auto is_finite = [&](size_t at) {
    return std::isfinite(means[3 * at]) && std::isfinite(means[3 * at + 1]) && std::isfinite(means[3 * at + 2]);
  };
  for (size_t at = 0; at < count; ++at) {
    if (!is_finite(at)) continue;
    for (int axis = 0; axis < 3; ++axis) {
      low[axis] = std::min(low[axis], means[3 * at + axis]);
      high[axis] = std::max(high[axis], means[3 * at + axis]);
    }
  }
  std::vector<std::pair<uint64_t, uint32_t>> keys(count);
  for (size_t at = 0; at < count; ++at) {
    uint64_t key = 0;
    for (int axis = 0; axis < 3 && is_finite(at); ++axis) {
      const double extent = static_cast<double>(high[axis]) - low[axis];
      const double share = extent > 0.0 ? (static_cast<double>(means[3 * at + axis]) - low[axis]) / extent : 0.0;
      const auto cell = static_cast<uint64_t>(share * ((1 << kBits) - 1));
      for (int bit = 0; bit < kBits; ++bit) key |= (cell >> bit & 1) << (3 * bit + axis);
    }
    keys[at] = {is_finite(at) ? key : std::numeric_limits<uint64_t>::max(), static_cast<uint32_t>(at)};
  }
  std::sort(keys.begin(), keys.end());
  for (size_t at = 0; at < count; ++at) order[at] = keys[at].second;
}

}  // namespace rf3dgs
