// (1 - w) L1 + w (1 - SSIM) of two pictures and its gradient with respect to the first.
//
// Pixels of weight zero count as equal in both pictures: there the second is the first.
#pragma once

#include <cstdint>
#include <vector>

namespace rf3dgs {

// What a picture is compared with. `mean` and `square` [row, loss_stride] are its blurred values and squares, or null.
struct LossTarget {
  const float* picture;  // [row, col, channel]
  const float* weight;   // [row, col] or null
  const float* mean;
  const float* square;
  int height, width, channels;
};

// Memory that one loss leaves to the next.
struct LossMemory {
  std::vector<float> partial, composed, scratch;
  std::vector<uint8_t> is_composed;
};

// `gradient` [row, col, channel], when not null, receives the derivative.
double l1_ssim(const float* picture, const LossTarget& target, float ssim_weight, int threads, float* gradient,
               LossMemory& memory);

// The blurred values and squares of a target, [row, loss_stride] each.
void target_statistics(const LossTarget& target, int threads, float* mean, float* square);

}  // namespace rf3dgs
