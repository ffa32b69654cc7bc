#include "splats/image_loss.hpp"

#include <cmath>
#include <cstddef>
#include <memory>
#include <vector>

#include "core/thread_pool.hpp"
#include "splats/kernels.hpp"

namespace rf3dgs {

double l1_ssim(const float* picture, const float* target, const float* weight, int height, int width, int channels,
               float ssim_weight, int threads, float* gradient) {
  const Kernels& kernel = kernels();
  const size_t plane = static_cast<size_t>(height) * width;
  const int rows = channels * height;
  const size_t scratch_size = 5 * (static_cast<size_t>(width) + 32);
  std::unique_ptr<float[]> blurred(new float[5 * channels * plane]), partial(new float[3 * channels * plane]);
  const auto map = [&](const std::unique_ptr<float[]>& maps, int kind, int channel) {
    return maps.get() + (static_cast<size_t>(kind) * channels + channel) * plane;
  };

  parallel_for(rows, threads, [&](int task) {
    const int channel = task / height, row = task % height;
    std::vector<float> scratch(scratch_size);
    float* out[5];
    for (int kind = 0; kind < 5; ++kind) out[kind] = map(blurred, kind, channel) + static_cast<size_t>(row) * width;
    const size_t at = static_cast<size_t>(row) * width * channels + channel;
    kernel.ssim_row(picture + at, target + at, width, channels, out, scratch.data());
  });

  std::vector<double> ssim(rows), l1(rows);
  parallel_for(rows, threads, [&](int task) {
    const int channel = task / height, row = task % height;
    std::vector<float> scratch(scratch_size);
    const float* in[5];
    float* out[3];
    for (int kind = 0; kind < 5; ++kind) in[kind] = map(blurred, kind, channel);
    for (int kind = 0; kind < 3; ++kind) out[kind] = map(partial, kind, channel) + static_cast<size_t>(row) * width;
    const float* share = weight == nullptr ? nullptr : weight + static_cast<size_t>(row) * width;
    ssim[task] = kernel.ssim_column(in, row, width, height, share, out, scratch.data());
    double sum = 0.0;
    const size_t first = static_cast<size_t>(row) * width;
    for (int x = 0; x < width; ++x) {
      const size_t at = (first + x) * channels + channel;
      sum += (share == nullptr ? 1.0f : share[x]) * std::fabs(picture[at] - target[at]);
    }
    l1[task] = sum;
  });

  double total_weight = static_cast<double>(plane);
  if (weight != nullptr) {
    total_weight = 0.0;
    for (size_t at = 0; at < plane; ++at) total_weight += weight[at];
  }
  const double scale = 1.0 / (total_weight * channels);
  double ssim_sum = 0.0, l1_sum = 0.0;
  for (int task = 0; task < rows; ++task) {
    ssim_sum += ssim[task];
    l1_sum += l1[task];
  }
  if (gradient != nullptr) {
    parallel_for(rows, threads, [&](int task) {
      const int channel = task / height, row = task % height;
      std::vector<float> scratch(scratch_size);
      const float* in[3];
      for (int kind = 0; kind < 3; ++kind) in[kind] = map(partial, kind, channel);
      const float* share = weight == nullptr ? nullptr : weight + static_cast<size_t>(row) * width;
      const size_t at = static_cast<size_t>(row) * width * channels + channel;
      kernel.ssim_gradient_row(in, row, width, height, picture + at, target + at, channels, share,
                               static_cast<float>((1.0 - ssim_weight) * scale), static_cast<float>(-ssim_weight * scale),
                               gradient + at, scratch.data());
    });
  }
  return (1.0 - ssim_weight) * l1_sum * scale + ssim_weight * (1.0 - ssim_sum * scale);
}

}  // namespace rf3dgs
