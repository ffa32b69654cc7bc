#include "splats/image_loss.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <memory>
#include <vector>

#include "core/thread_pool.hpp"
#include "splats/constants.hpp"
#include "splats/kernels.hpp"

namespace rf3dgs {
namespace {

constexpr int kRows = 4;  // of one task

struct Window {
  float tap[kSsimTaps];
};

Window ssim_window() {
  double taps[kSsimTaps], total = 0.0;
  for (int at = 0; at < kSsimTaps; ++at) {
    const double distance = (at - kSsimRadius) / static_cast<double>(kSsimSigma);
    total += taps[at] = std::exp(-0.5 * distance * distance);
  }
  Window window;
  for (int at = 0; at < kSsimTaps; ++at) window.tap[at] = static_cast<float>(taps[at] / total);
  return window;
}

}  // namespace

double l1_ssim(const float* picture, const float* target, const float* weight, int height, int width, int channels,
               float ssim_weight, int threads, float* gradient) {
  static const Window window = ssim_window();
  const Kernels& kernel = kernels();
  const PicturePair pair = {picture, target, weight, window.tap, height, width, channels};
  const size_t stride = loss_stride(width, channels), plane = height * stride;
  const size_t scratch_size = 6 * static_cast<size_t>(loss_line(width, channels));
  const int tasks = (height + kRows - 1) / kRows;
  const std::unique_ptr<float[]> partial(new float[3 * plane]);

  std::vector<LossSums> sums(height);
  parallel_for(tasks, threads, [&](int task) {
    const std::unique_ptr<float[]> scratch(new float[scratch_size]);
    for (int row = task * kRows; row < std::min(height, (task + 1) * kRows); ++row) {
      float* const line = partial.get() + row * stride;
      float* const out[3] = {line, line + plane, line + 2 * plane};
      sums[row] = kernel.ssim_row(pair, row, out, scratch.get());
    }
  });

  double total_weight = static_cast<double>(height) * width;
  if (weight != nullptr) {
    total_weight = 0.0;
    for (size_t at = 0; at < static_cast<size_t>(height) * width; ++at) total_weight += weight[at];
  }
  const double scale = 1.0 / (total_weight * channels);
  double ssim = 0.0, l1 = 0.0;
  for (const LossSums& row : sums) {
    ssim += row.ssim;
    l1 += row.l1;
  }
  if (gradient != nullptr) {
    const float* const in[3] = {partial.get(), partial.get() + plane, partial.get() + 2 * plane};
    const float l1_scale = static_cast<float>((1.0 - ssim_weight) * scale);
    const float ssim_scale = static_cast<float>(-ssim_weight * scale);
    parallel_for(tasks, threads, [&](int task) {
      const std::unique_ptr<float[]> scratch(new float[scratch_size]);
      for (int row = task * kRows; row < std::min(height, (task + 1) * kRows); ++row) {
        kernel.ssim_gradient_row(pair, row, in, l1_scale, ssim_scale, gradient, scratch.get());
      }
    });
  }
  return (1.0 - ssim_weight) * l1 * scale + ssim_weight * (1.0 - ssim * scale);
}

}  // namespace rf3dgs
