#include "splats/image_loss.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <vector>

#include "core/buffer.hpp"
#include "core/thread_pool.hpp"
#include "splats/constants.hpp"
#include "splats/kernels.hpp"

namespace rf3dgs {
namespace {

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

// Calls work(first, rows, scratch) for all bands of rows.
template <class BandWork>
void each_band(const PicturePair& pair, int threads, const BandWork& work) {
  parallel_for((pair.height + kLossRows - 1) / kLossRows, threads, [&](int band) {
    thread_local Buffer<float> scratch;
    const int first = band * kLossRows;
    work(first, std::min(kLossRows, pair.height - first), scratch.resize(loss_scratch(pair.width, pair.channels)));
  });
}

// Where pixels count as equal, a copy of the target with the picture in them; which rows see such pixels.
void compose(PicturePair& pair, LossMemory& memory) {
  const size_t pixels = static_cast<size_t>(pair.height) * pair.width, channels = pair.channels;
  memory.is_composed.assign(pair.height, 0);
  pair.is_composed = memory.is_composed.data();
  if (pair.weight == nullptr || std::find(pair.weight, pair.weight + pixels, 0.0f) == pair.weight + pixels) return;
  memory.composed.assign(pair.b, pair.b + pixels * channels);
  for (int row = 0; row < pair.height; ++row) {
    bool found = false;
    const size_t start = static_cast<size_t>(row) * pair.width;
    for (size_t pixel = start; pixel < start + pair.width; ++pixel) {
      if (pair.weight[pixel] != 0.0f) continue;
      found = true;
      std::copy_n(pair.a + pixel * channels, channels, memory.composed.data() + pixel * channels);
    }
    if (!found) continue;
    const int first = std::max(0, row - kSsimRadius), last = std::min(pair.height - 1, row + kSsimRadius);
    std::fill(memory.is_composed.begin() + first, memory.is_composed.begin() + last + 1, uint8_t{1});
  }
  pair.b = memory.composed.data();
}

PicturePair pair_of(const float* picture, const LossTarget& target) {
  static const Window window = ssim_window();
  return {picture,     target.picture, target.weight, window.tap,      target.mean,
          target.square, nullptr,        target.height, target.width, target.channels};
}

}  // namespace

double l1_ssim(const float* picture, const LossTarget& target, float ssim_weight, int threads, float* gradient,
               LossMemory& memory) {
  const Kernels& kernel = kernels();
  PicturePair pair = pair_of(picture, target);
  compose(pair, memory);
  const bool with_ssim = ssim_weight != 0.0f;
  const size_t stride = loss_stride(pair.width, pair.channels), plane = pair.height * stride;
  if (with_ssim) memory.partial.resize(3 * plane);
  float* const partial = memory.partial.data();

  std::vector<LossSums> sums(pair.height);
  const auto sum_rows = with_ssim ? kernel.ssim_rows : kernel.l1_rows;
  float* const out[3] = {partial, partial + plane, partial + 2 * plane};
  each_band(pair, threads, [&](int first, int rows, float* scratch) {
    sum_rows(pair, first, rows, out, sums.data(), scratch);
  });

  double total_weight = static_cast<double>(pair.height) * pair.width;
  if (pair.weight != nullptr) {
    total_weight = 0.0;
    for (size_t at = 0; at < static_cast<size_t>(pair.height) * pair.width; ++at) total_weight += pair.weight[at];
  }
  const double scale = 1.0 / (total_weight * pair.channels);
  double ssim = 0.0, l1 = 0.0;
  for (const LossSums& row : sums) {
    ssim += row.ssim;
    l1 += row.l1;
  }
  if (gradient != nullptr) {
    const float* const in[3] = {partial, partial + plane, partial + 2 * plane};
    const float l1_scale = static_cast<float>((1.0 - ssim_weight) * scale);
    const float ssim_scale = static_cast<float>(-ssim_weight * scale);
    const auto gradient_rows = with_ssim ? kernel.ssim_gradient_rows : kernel.l1_gradient_rows;
    each_band(pair, threads, [&](int first, int rows, float* scratch) {
      gradient_rows(pair, first, rows, in, l1_scale, ssim_scale, gradient, scratch);
    });
  }
  return (1.0 - ssim_weight) * l1 * scale + ssim_weight * (1.0 - ssim * scale);
}

void target_statistics(const LossTarget& target, int threads, float* mean, float* square) {
  const PicturePair pair = pair_of(target.picture, target);
  each_band(pair, threads, [&](int first, int rows, float* scratch) {
    kernels().target_rows(pair, first, rows, mean, square, scratch);
  });
}

}  // namespace rf3dgs
