// (1 - w) L1 + w (1 - SSIM) of two pictures and its gradient with respect to the first.
#pragma once

namespace rf3dgs {

// Pictures are [row, col, channel]; `weight` [row, col] or null. `gradient`, when not null, receives the derivative.
double l1_ssim(const float* picture, const float* target, const float* weight, int height, int width, int channels,
               float ssim_weight, int threads, float* gradient);

}  // namespace rf3dgs
