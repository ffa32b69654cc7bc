// A training step without a detour: draw, compare, go back and move the Gaussians that were drawn by Adam.
//
// The arrays belong to the caller and lie in the trainer's order, the Morton order of the means, so that Gaussians that
// are seen together are neighbours in memory. Gaussians that a view does not draw keep parameters and moments.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <vector>

#include "splats/image_loss.hpp"
#include "splats/kernels.hpp"
#include "splats/rasterize.hpp"

namespace rf3dgs {

// Gaussians and their moments. Null values are not trained.
struct Population {
  size_t count;
  const float *means, *quats;
  float *scales, *opacities;  // activated
  float* bounds;              // of groups (see `Geometry`), or null where means or scales move
  const float* sh;            // [gaussian, channels, lanes]
  Trained trained_means, trained_quats, trained_log_scales, trained_logits, trained_sh;
  const float* base;   // [gaussian, channels] or null
  const float* along;  // [channels] or null
  const uint32_t* order;
  float* screen;  // [gaussian, 3]: sum of |d loss / d centre|, views, largest radius; or null
  int channels, lanes, bases;
  float offset;
  bool clamp;
  float beta1, beta2, eps;
  bool half_moments;
};

// How a picture is made of the population.
struct Drawing {
  View view;
  const float* extra;  // [gaussian, extras] in the caller's order, or null
  int extras;
  bool depth;
  const float* background;  // [width of values] or null
  float gate;
  Finishing finishing;
  const float* added;  // [row, col, width of values] or null
};

// Learning rates; `steps` counts the updates of the run, this one included.
struct Rates {
  float means, quats, log_scales, opacity;
  const float* sh;  // [channels, lanes]
  float shrink;     // weight of the mean square of the coefficients above the first
  int64_t steps;
};

class Trainer {
 public:
  // Writes [row, col, width of values] and [row, col]; draws anew what `update` goes back through.
  void draw(const Population& population, const Drawing& drawing, int threads, float* picture, float* weight);
  // Moves what the last drawing showed, by the gradients of its picture and (or null) its weight. Returns the part of
  // the loss that shrinks the harmonics.
  double update(const Population& population, const float* picture_gradient, const float* weight_gradient,
                const Rates& rates, int threads);
  // `draw`, loss and `update`; returns the loss.
  double step(const Population& population, const Drawing& drawing, const LossTarget& target, float ssim_weight,
              const Rates& rates, int threads);

  // [gaussian] of the last drawing, in the trainer's order [pixel]; and a copy in the caller's order.
  const float* radii() const { return radii_.data(); }
  void copy_radii(const Population& population, int threads, float* out) const;
  bool has_drawn() const { return scene_ != nullptr; }
  const Drawing& drawing() const { return drawing_; }

 private:
  Shading shading(const Population& population) const;
  void draw_raw(const Population& population, const Drawing& drawing, int threads);

  Drawing drawing_{};
  std::unique_ptr<Scene> scene_;
  std::vector<float> raw_, weight_, radii_, finished_, gradient_, raw_gradient_, weight_gradient_;
  LossMemory loss_memory_;
};

// One picture of Gaussians as they are, without training. With `shading.lanes` of zero the harmonics are [gaussian,
// bases, channels].
void draw_once(const float* means, const float* quats, const float* log_scales, const float* logits, size_t count,
               const Shading& shading, const Drawing& drawing, int threads, float* picture, float* weight, float* radii);

}  // namespace rf3dgs
