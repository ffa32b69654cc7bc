#include "splats/trainer.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <mutex>
#include <utility>

#include "core/thread_pool.hpp"

namespace rf3dgs {
namespace {

constexpr size_t kPixelChunk = 4096;

// Calls work(first, count) for every chunk of the pixels.
template <class PixelWork>
void each_pixel_chunk(size_t pixels, int threads, const PixelWork& work) {
  parallel_for(static_cast<int>((pixels + kPixelChunk - 1) / kPixelChunk), threads, [&](int chunk) {
    const size_t first = chunk * kPixelChunk;
    work(first, std::min(kPixelChunk, pixels - first));
  });
}

size_t pixels_of(const View& view) { return static_cast<size_t>(view.width) * view.height; }

void finish_picture(const Drawing& drawing, int threads, const float* raw, const float* weight, float* out) {
  const size_t width = drawing.finishing.channels;
  each_pixel_chunk(pixels_of(drawing.view), threads, [&](size_t first, size_t count) {
    const float* added = drawing.added == nullptr ? nullptr : drawing.added + first * width;
    kernels().training.finish(drawing.finishing, count, raw + first * width, weight + first, added, out + first * width);
  });
}

// The centre of a view in the world and the row of its depth.
void place_viewer(const View& view, Shading& shading) {
  for (int axis = 0; axis < 3; ++axis) {
    double sum = 0.0;
    for (int row = 0; row < 3; ++row) sum -= static_cast<double>(view.rotation[3 * row + axis]) * view.translation[row];
    shading.centre[axis] = static_cast<float>(sum);
    shading.axis[axis] = view.rotation[6 + axis];
  }
  shading.axis[3] = view.translation[2];
  shading.range = view.kind == Kind::sphere;
}

void show(const Shading& shading, const Drawing& drawing, Shading& shown) {
  shown = shading;
  shown.extra = drawing.extra;
  shown.extras = drawing.extras;
  shown.depth = drawing.depth;
  place_viewer(drawing.view, shown);
}

// Adds one view to the statistic of the pull at projected centres, in units of half a picture.
void observe(const Population& population, const View& view, const float* radii, const uint32_t* sources, size_t count,
             const float* of_centre) {
  for (size_t at = 0; at < count; ++at) {
    float* row = population.screen + 3 * static_cast<size_t>(sources[at]);
    const float x = of_centre[2 * at] * 0.5f * view.width, y = of_centre[2 * at + 1] * 0.5f * view.height;
    row[0] += std::sqrt(x * x + y * y);
    row[1] += 1.0f;
    row[2] = std::max(row[2], radii[sources[at]]);
  }
}

Geometry geometry_of(const Population& population) {
  return {population.means, population.quats, population.scales, population.opacities, nullptr, population.bounds};
}

// Calls work(first, count) for every run of drawn splats among `count`.
template <class RunWork>
void each_run(const float* radii, const uint32_t* sources, size_t count, const RunWork& work) {
  for (size_t first = 0; first < count;) {
    size_t end = first;
    while (end < count && radii[sources[end]] > 0.0f) ++end;
    if (end > first) work(first, end - first);
    first = end + 1;
  }
}

// The depth is a channel that depends on the mean.
void add_depth(const Shading& shading, size_t count, const float* values_gradient, float* means) {
  const int width = shading.width();
  for (size_t at = 0; at < count; ++at) {
    const float of_depth = values_gradient[at * width + width - 1];
    for (int axis = 0; axis < 3; ++axis) means[3 * at + axis] += of_depth * shading.axis[axis];
  }
}

}  // namespace

Shading Trainer::shading(const Population& population) const {
  Shading shading{};
  shading.means = population.means;
  shading.coefficients = population.sh;
  shading.base = population.base;
  shading.along = population.along;
  shading.order = population.order;
  shading.channels = population.channels;
  shading.bases = population.bases;
  shading.lanes = population.lanes;
  shading.clamp = population.clamp;
  shading.offset = population.offset;
  Shading shown;
  show(shading, drawing_, shown);
  return shown;
}

void Trainer::draw_raw(const Population& population, const Drawing& drawing, int threads) {
  drawing_ = drawing;
  const Shading shading = this->shading(population);
  const size_t pixels = pixels_of(drawing.view);
  raw_.resize(pixels * shading.width());
  weight_.resize(pixels);
  radii_.resize(population.count);
  scene_.reset();
  scene_ = rasterize(drawing.view, population.count, geometry_of(population), shading.width(),
                     [&](size_t begin, size_t end, const uint32_t* sources, float* values) {
                       kernels().training.shade(shading, sources, end - begin, values);
                     },
                     drawing.background, drawing.gate, threads, raw_.data(), weight_.data(), radii_.data());
}

void Trainer::copy_radii(const Population& population, int threads, float* out) const {
  std::fill_n(out, population.count, 0.0f);
  const SceneMemory& memory = *scene_->memory;
  parallel_for(scene_->chunks(), threads, [&](int chunk) {
    const uint32_t* const sources = memory.sources.data() + chunk * kChunk;
    for (size_t at = 0; at < memory.chunk_visible[chunk]; ++at) {
      out[population.order[sources[at]]] = radii_[sources[at]];
    }
  });
}

void Trainer::draw(const Population& population, const Drawing& drawing, int threads, float* picture, float* weight) {
  draw_raw(population, drawing, threads);
  std::copy(weight_.begin(), weight_.end(), weight);
  if (drawing.finishing.trivial(drawing.added)) {
    std::copy(raw_.begin(), raw_.end(), picture);
  } else {
    finish_picture(drawing_, threads, raw_.data(), weight_.data(), picture);
  }
}

double Trainer::update(const Population& population, const float* picture_gradient, const float* weight_gradient,
                       const Rates& rates, int threads) {
  const Shading shading = this->shading(population);
  const TrainingKernels& kernel = kernels().training;
  const Finishing& finishing = drawing_.finishing;
  const size_t pixels = pixels_of(drawing_.view), width = shading.width();
  if (!finishing.trivial(drawing_.added)) {
    raw_gradient_.resize(pixels * width);
    if (finishing.normalise) {
      weight_gradient_.assign(pixels, 0.0f);
      if (weight_gradient != nullptr) std::copy_n(weight_gradient, pixels, weight_gradient_.data());
      weight_gradient = weight_gradient_.data();
    }
    each_pixel_chunk(pixels, threads, [&](size_t first, size_t count) {
      const float* added = drawing_.added == nullptr ? nullptr : drawing_.added + first * width;
      kernel.finish_backward(finishing, count, raw_.data() + first * width, weight_.data() + first, added,
                             picture_gradient + first * width, raw_gradient_.data() + first * width,
                             finishing.normalise ? weight_gradient_.data() + first : nullptr);
    });
    picture_gradient = raw_gradient_.data();
  }

  const double unbiased = 1.0 - std::pow(static_cast<double>(population.beta1), static_cast<double>(rates.steps));
  const double unbiased_square = 1.0 - std::pow(static_cast<double>(population.beta2), static_cast<double>(rates.steps));
  const AdamTerms adam = {population.beta1, population.beta2, static_cast<float>(1.0 / unbiased_square), population.eps,
                          population.half_moments};
  const auto paced = [&](float rate) { return static_cast<float>(rate / unbiased); };
  const size_t row = static_cast<size_t>(population.channels) * population.lanes;
  std::vector<float> sh_rates(row);
  if (population.trained_sh.value != nullptr) std::transform(rates.sh, rates.sh + row, sh_rates.begin(), paced);
  const size_t drawn = std::count_if(radii_.begin(), radii_.end(), [](float radius) { return radius > 0.0f; });
  const double shrinking = std::max<double>(1.0, static_cast<double>(drawn) * population.channels * (population.bases - 1));
  const HarmonicsUpdate of_sh = {population.trained_sh, sh_rates.data(), static_cast<float>(2.0 * rates.shrink / shrinking)};
  const ShapeUpdate of_shape = {population.trained_means, population.trained_quats, population.trained_log_scales,
                                population.trained_logits, paced(rates.means), paced(rates.quats),
                                paced(rates.log_scales), paced(rates.opacity), population.scales, population.opacities};
  const bool moves = of_shape.means.value != nullptr, shapes = moves || of_shape.logit_opacities.value != nullptr;
  std::mutex squares_mutex;
  std::vector<std::pair<size_t, double>> squares;
  rasterize_backward(
      *scene_, geometry_of(population), raw_.data(), weight_.data(), picture_gradient, weight_gradient,
      moves ? Which::everything : Which::appearance, threads,
      [&](size_t begin, size_t end, const uint32_t* sources, const float* of_values, const float* of_opacity,
          const GeometryRows* rows) {
        double sum = 0.0;
        if (moves && shading.depth) add_depth(shading, end - begin, of_values, rows->means);
        each_run(radii_.data(), sources, end - begin, [&](size_t first, size_t count) {
          if (moves && population.screen != nullptr) {
            observe(population, drawing_.view, radii_.data(), sources + first, count, rows->offset + 2 * first);
          }
          if (population.trained_sh.value != nullptr) {
            sum += kernel.update_harmonics(shading, of_sh, adam, sources + first, count,
                                           scene_->memory->values.data() + (begin + first) * width, of_values + first * width);
          }
          if (!shapes) return;
          kernel.update_shapes(of_shape, adam, sources + first, count, moves ? rows->means + 3 * first : nullptr,
                               moves ? rows->quats + 4 * first : nullptr, moves ? rows->scales + 3 * first : nullptr,
                               of_opacity + first);
        });
        std::lock_guard<std::mutex> lock(squares_mutex);
        squares.emplace_back(begin, sum);
      });
  std::sort(squares.begin(), squares.end());
  double total = 0.0;
  for (const auto& [begin, sum] : squares) total += sum;
  scene_.reset();
  return rates.shrink * total / shrinking;
}

double Trainer::step(const Population& population, const Drawing& drawing, const LossTarget& target, float ssim_weight,
                     const Rates& rates, int threads) {
  draw_raw(population, drawing, threads);
  const float* picture = raw_.data();
  if (!drawing.finishing.trivial(drawing.added)) {
    finished_.resize(raw_.size());
    finish_picture(drawing_, threads, raw_.data(), weight_.data(), finished_.data());
    picture = finished_.data();
  }
  gradient_.resize(raw_.size());
  const double loss = l1_ssim(picture, target, ssim_weight, threads, gradient_.data(), loss_memory_);
  return loss + update(population, gradient_.data(), nullptr, rates, threads);
}

void draw_once(const float* means, const float* quats, const float* log_scales, const float* logits, size_t count,
               const Shading& shading, const Drawing& drawing, int threads, float* picture, float* weight, float* radii) {
  const std::unique_ptr<float[]> activated(new float[4 * count]);
  float *scales = activated.get(), *opacities = scales + 3 * count;
  parallel_for(static_cast<int>((count + kPixelChunk - 1) / kPixelChunk), threads, [&](int chunk) {
    const size_t first = chunk * kPixelChunk, some = std::min(kPixelChunk, count - first);
    kernels().training.exponentials(log_scales + 3 * first, 3 * some, scales + 3 * first);
    kernels().training.sigmoids(logits + first, some, opacities + first);
  });
  Shading shown;
  show(shading, drawing, shown);
  const auto shade = shown.lanes > 0 ? kernels().training.shade : kernels().training.shade_plain;
  rasterize(drawing.view, count, {means, quats, scales, opacities, nullptr}, shown.width(),
            [&](size_t begin, size_t end, const uint32_t* sources, float* values) {
              shade(shown, sources, end - begin, values);
            },
            drawing.background, drawing.gate, threads, picture, weight, radii);
  if (!drawing.finishing.trivial(drawing.added)) finish_picture(drawing, threads, picture, weight, picture);
}

}  // namespace rf3dgs
