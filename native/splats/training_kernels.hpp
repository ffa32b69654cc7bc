// What the kernels of training see: harmonics that become values, Adam, and the finishing of pictures.
//
// Trained arrays lie in the trainer's order of the Gaussians. The harmonics of a Gaussian are one row
// [channel, lane] of 1, 4 or 16 lanes; 9 coefficients take 16 lanes.
#pragma once

#include <cstddef>
#include <cstdint>

namespace rf3dgs {

// From Gaussians to the values that a viewer sees: harmonics first, then constant channels, then the depth.
struct Shading {
  const float* means;         // [gaussian, 3]
  const float* coefficients;  // [gaussian, channels, lanes], or [gaussian, bases, channels] for `shade_plain`
  const float* base;          // [gaussian, channels] added, or null
  const float* along;         // [channels] times the distance to the viewer added, or null
  const float* extra;         // [gaussian, extras] or null
  const uint32_t* order;      // the row of `extra` that belongs to a Gaussian; null where it is its own
  int channels, extras;
  int bases;                  // how many of the coefficients count
  int lanes;                  // how many floats a channel's coefficients take
  bool depth;                 // one more channel
  bool clamp;                 // negative values become -0, which remembers that they let no gradient through
  float offset;
  float centre[3];            // of the viewer
  float axis[4];              // depth = axis . (mean, 1) for a plane picture
  bool range;                 // the depth is the distance to the viewer

  int width() const { return channels + extras + (depth ? 1 : 0); }
};

// An array that Adam moves, with its moments: floats, or the upper halves of floats.
struct Trained {
  float* value;
  void* first;
  void* second;
};

// Adam (Kingma and Ba 2015), with max(sqrt(v), eps) in place of sqrt(v) + eps. Rates are divided by 1 - beta1^t and
// `unbias` is 1 / (1 - beta2^t).
struct AdamTerms {
  float beta1, beta2, unbias, eps;
  bool half_moments;
};

// Rates of the geometry and of the opacity; null arrays are not trained.
struct ShapeUpdate {
  Trained means, quats, log_scales, logit_opacities;
  float rate_means, rate_quats, rate_log_scales, rate_opacity;
  float* scales;     // activated
  float* opacities;  // activated
};

struct HarmonicsUpdate {
  Trained sh;
  const float* rates;  // [channels, lanes]
  float shrink;        // times a coefficient above the first is added to its gradient
};

constexpr int kMostFinished = 16;  // channels of a picture that is finished

// What is done to a composited picture: divided by its weight, added to, brought into a window of decibels.
struct Finishing {
  int channels;
  bool normalise;
  const uint8_t* in_window;  // [channels], or null where no channel is
  float inverse_floor, gain;  // window(v) = gain ln(1 + max(v, 0) inverse_floor)

  bool trivial(const float* added) const { return !normalise && in_window == nullptr && added == nullptr; }
};

struct TrainingKernels {
  // Values [count, width] of the Gaussians `sources` [count].
  void (*shade)(const Shading&, const uint32_t* sources, size_t count, float* values);
  void (*shade_plain)(const Shading&, const uint32_t* sources, size_t count, float* values);
  // One step of Adam for the harmonics, or for shape and opacity, of the Gaussians `sources` [count] by rows of
  // gradients. `update_harmonics` returns the sum of squares of the coefficients that shrink.
  double (*update_harmonics)(const Shading&, const HarmonicsUpdate&, const AdamTerms&, const uint32_t* sources,
                             size_t count, const float* values, const float* gradient);
  void (*update_shapes)(const ShapeUpdate&, const AdamTerms&, const uint32_t* sources, size_t count, const float* means,
                        const float* quats, const float* scales, const float* opacities);
  // e^x of `count` floats, and 1 / (1 + e^-x).
  void (*exponentials)(const float* from, size_t count, float* to);
  void (*sigmoids)(const float* from, size_t count, float* to);
  // `count` pixels of a picture; the raw picture may be the finished one when nothing divides.
  void (*finish)(const Finishing&, size_t count, const float* raw, const float* weight, const float* added, float* out);
  // From the gradient of a finished picture to that of the raw one and, when it divides, of the weight (added to).
  void (*finish_backward)(const Finishing&, size_t count, const float* raw, const float* weight, const float* added,
                          const float* gradient, float* raw_gradient, float* weight_gradient);
};

}  // namespace rf3dgs
