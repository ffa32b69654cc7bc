// What Python sees of the picture loss and of training.
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "bind.hpp"
#include "bind_loss.hpp"
#include "splats/morton.hpp"
#include "splats/trainer.hpp"

namespace rf3dgs {
namespace {

using namespace nb::literals;

// The floats of an array of a dictionary that must have `size` of them; null where it is missing.
float* floats_of(const nb::dict& arrays, const std::string& name, size_t size) {
  if (!arrays.contains(name.c_str())) return nullptr;
  const auto array = nb::cast<nb::ndarray<float, nb::c_contig, nb::device::cpu>>(arrays[name.c_str()]);
  require(array.size() == size, "an array of the trainer does not have the size that its Gaussians ask for");
  return array.data();
}

// A parameter with its moments; all null where it has none, because it is not trained.
Trained trained_of(const nb::dict& arrays, const std::string& name, size_t size, bool half) {
  const auto moment = [&](const std::string& full) -> void* {
    if (!half || !arrays.contains(full.c_str())) return floats_of(arrays, full, size);
    const auto array = nb::cast<nb::ndarray<int16_t, nb::c_contig, nb::device::cpu>>(arrays[full.c_str()]);
    require(array.size() == size, "a moment of the trainer does not have the size of its parameter");
    return array.data();
  };
  const Trained trained = {floats_of(arrays, name, size), moment("first." + name), moment("second." + name)};
  return trained.first == nullptr || trained.second == nullptr ? Trained{} : trained;
}

// What a drawing refers to, kept for as long as it is needed.
struct Wishes {
  std::optional<In<-1, -1>> extra;
  std::optional<In<-1>> background;
  std::optional<In<-1, -1, -1>> added;
  std::vector<uint8_t> in_window;
  Drawing drawing{};
};

std::shared_ptr<Wishes> wishes_of(const In<4, 4>& viewmat, const std::optional<In<3, 3>>& camera, int width, int height,
                                  size_t count, int channels, std::optional<In<-1, -1>> extra, bool depth,
                                  std::optional<In<-1>> background, float blur, std::optional<float> gate,
                                  bool normalise, const std::vector<bool>& in_window, double floor_db, double ceil_db,
                                  std::optional<In<-1, -1, -1>> added) {
  auto wishes = std::make_shared<Wishes>(Wishes{std::move(extra), std::move(background), std::move(added), {}, {}});
  Drawing& drawing = wishes->drawing;
  drawing.view = view_of(viewmat, camera, width, height, blur);
  drawing.extra = data_or_null(wishes->extra);
  drawing.extras = wishes->extra ? static_cast<int>(wishes->extra->shape(1)) : 0;
  drawing.depth = depth;
  drawing.background = data_or_null(wishes->background);
  drawing.gate = gate.value_or(std::numeric_limits<float>::infinity());
  drawing.added = data_or_null(wishes->added);
  const size_t values = static_cast<size_t>(channels + drawing.extras + (depth ? 1 : 0));
  require((!wishes->extra || wishes->extra->shape(0) == count) &&
              (!wishes->background || wishes->background->shape(0) == values) &&
              (!wishes->added || (wishes->added->shape(0) == static_cast<size_t>(height) &&
                                  wishes->added->shape(1) == static_cast<size_t>(width) &&
                                  wishes->added->shape(2) == values)) &&
              (in_window.size() == 1 || in_window.size() == values),
          "what is to be drawn does not fit the Gaussians or the picture");
  Finishing& finishing = drawing.finishing;
  finishing.channels = static_cast<int>(values);
  finishing.normalise = normalise;
  if (std::find(in_window.begin(), in_window.end(), true) != in_window.end()) {
    for (size_t at = 0; at < values; ++at) wishes->in_window.push_back(in_window[in_window.size() == 1 ? 0 : at]);
    finishing.in_window = wishes->in_window.data();
    finishing.inverse_floor = static_cast<float>(std::pow(10.0, -floor_db / 10.0));
    finishing.gain = static_cast<float>(10.0 / std::log(10.0) / (ceil_db - floor_db));
  }
  require(finishing.trivial(drawing.added) || finishing.channels <= kMostFinished, "too many channels to be finished");
  return wishes;
}

// A trainer and the arrays that it works on, which belong to Python.
class BoundTrainer {
 public:
  BoundTrainer(nb::dict arrays, float offset, bool clamp, float beta1, float beta2, float eps, bool half)
      : arrays_(std::move(arrays)) {
    const auto order = nb::cast<nb::ndarray<int32_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>>(arrays_["order"]);
    const auto sh = nb::cast<Out<-1, -1, -1>>(arrays_["sh"]);
    const size_t count = order.size();
    Population& p = population_;
    p.count = count;
    p.channels = static_cast<int>(sh.shape(1));
    p.lanes = static_cast<int>(sh.shape(2));
    require(sh.shape(0) == count && p.channels > 0 && (p.lanes == 1 || p.lanes == 4 || p.lanes == 16),
            "harmonics must be [gaussian, channel, 1, 4 or 16]");
    const size_t row = static_cast<size_t>(p.channels) * p.lanes;
    p.order = reinterpret_cast<const uint32_t*>(order.data());
    p.means = floats_of(arrays_, "means", 3 * count);
    p.quats = floats_of(arrays_, "quats", 4 * count);
    log_scales_ = floats_of(arrays_, "log_scales", 3 * count);
    logits_ = floats_of(arrays_, "logit_opacities", count);
    p.scales = floats_of(arrays_, "scales", 3 * count);
    p.opacities = floats_of(arrays_, "opacities", count);
    p.bounds = floats_of(arrays_, "bounds", kBoundColumns * bound_groups(count));
    p.sh = sh.data();
    for (const char* name : {"means", "quats", "log_scales", "logit_opacities", "scales", "opacities"}) {
      require(arrays_.contains(name), "the trainer misses an array");
    }
    p.trained_means = trained_of(arrays_, "means", 3 * count, half);
    p.trained_quats = trained_of(arrays_, "quats", 4 * count, half);
    p.trained_log_scales = trained_of(arrays_, "log_scales", 3 * count, half);
    p.trained_logits = trained_of(arrays_, "logit_opacities", count, half);
    p.trained_sh = trained_of(arrays_, "sh", row * count, half);
    p.base = floats_of(arrays_, "base", p.channels * count);
    p.along = floats_of(arrays_, "along", p.channels);
    p.screen = floats_of(arrays_, "screen", 3 * count);
    p.offset = offset;
    p.clamp = clamp;
    p.beta1 = beta1;
    p.beta2 = beta2;
    p.eps = eps;
    p.half_moments = half;
  }

  void activate() {
    kernels().training.exponentials(log_scales_, 3 * population_.count, population_.scales);
    kernels().training.sigmoids(logits_, population_.count, population_.opacities);
    if (population_.bounds == nullptr) return;
    kernels().bound(population_.means, population_.scales, population_.count, 0, bound_groups(population_.count),
                    population_.bounds);
  }

  void draw(In<4, 4> viewmat, std::optional<In<3, 3>> camera, int width, int height, int bases,
            std::optional<In<-1, -1>> extra, bool depth, std::optional<In<-1>> background, float blur,
            std::optional<float> gate, bool normalise, std::vector<bool> in_window, double floor_db, double ceil_db,
            std::optional<In<-1, -1, -1>> added, Out<-1, -1, -1> picture, Out<-1, -1> weight, Out<-1> radii,
            int threads) {
    look(bases, wishes_of(viewmat, camera, width, height, population_.count, population_.channels, extra, depth,
                          background, blur, gate, normalise, in_window, floor_db, ceil_db, added));
    require(fits(picture) && weight.size() * wishes_->drawing.finishing.channels == picture.size() &&
                radii.size() == population_.count,
            "outputs do not fit the drawing");
    nb::gil_scoped_release released;
    trainer_.draw(population_, wishes_->drawing, threads, picture.data(), weight.data());
    trainer_.copy_radii(population_, threads, radii.data());
  }

  double update(In<-1, -1, -1> picture_gradient, std::optional<In<-1, -1>> weight_gradient, float means, float quats,
                float log_scales, float opacity, In<-1, -1> sh, float shrink, int64_t steps, int threads) {
    require(trainer_.has_drawn() && fits(picture_gradient) &&
                (!weight_gradient ||
                 weight_gradient->size() * wishes_->drawing.finishing.channels == picture_gradient.size()),
            "an update needs gradients of the picture that was drawn last");
    const Rates rates = rates_of(means, quats, log_scales, opacity, sh, shrink, steps);
    nb::gil_scoped_release released;
    return trainer_.update(population_, picture_gradient.data(), data_or_null(weight_gradient), rates, threads);
  }

  double step(In<4, 4> viewmat, std::optional<In<3, 3>> camera, int width, int height, int bases,
              std::optional<In<-1, -1>> extra, bool depth, std::optional<In<-1>> background, float blur,
              std::optional<float> gate, bool normalise, std::vector<bool> in_window, double floor_db, double ceil_db,
              std::optional<In<-1, -1, -1>> added, In<-1, -1, -1> target, std::optional<In<-1, -1>> weight,
              std::optional<In<2, -1, -1>> statistics, float ssim_weight, float means, float quats, float log_scales,
              float opacity, In<-1, -1> sh, float shrink, int64_t steps, int threads) {
    look(bases, wishes_of(viewmat, camera, width, height, population_.count, population_.channels, extra, depth,
                          background, blur, gate, normalise, in_window, floor_db, ceil_db, added));
    const LossTarget compared = target_of(target, weight, statistics);
    require(fits(target), "the target does not have the size and channels of what is drawn");
    const Rates rates = rates_of(means, quats, log_scales, opacity, sh, shrink, steps);
    nb::gil_scoped_release released;
    return trainer_.step(population_, wishes_->drawing, compared, ssim_weight, rates, threads);
  }

 private:
  void look(int bases, std::shared_ptr<Wishes> wishes) {
    require(bases > 0 && bases <= population_.lanes, "more harmonics than there are coefficients");
    population_.bases = bases;
    wishes_ = std::move(wishes);
  }

  bool fits(const auto& picture) const {
    const Drawing& drawing = wishes_->drawing;
    return picture.shape(0) == static_cast<size_t>(drawing.view.height) &&
           picture.shape(1) == static_cast<size_t>(drawing.view.width) &&
           picture.shape(2) == static_cast<size_t>(drawing.finishing.channels);
  }

  Rates rates_of(float means, float quats, float log_scales, float opacity, const In<-1, -1>& sh, float shrink,
                 int64_t steps) const {
    require(sh.shape(0) == static_cast<size_t>(population_.channels) &&
                sh.shape(1) == static_cast<size_t>(population_.lanes) && steps > 0,
            "rates of the harmonics must be [channel, lane], and steps count from one");
    return {means, quats, log_scales, opacity, sh.data(), shrink, steps};
  }

  nb::dict arrays_;
  const float* log_scales_ = nullptr;
  const float* logits_ = nullptr;
  Population population_{};
  std::shared_ptr<Wishes> wishes_;
  Trainer trainer_;
};

void order_of(In<-1, 3> means, nb::ndarray<int32_t, nb::shape<-1>, nb::c_contig, nb::device::cpu> order) {
  require(order.size() == means.shape(0), "an order needs one row per Gaussian");
  nb::gil_scoped_release released;
  morton_order(means.data(), means.shape(0), reinterpret_cast<uint32_t*>(order.data()));
}

void draw_plain(In<-1, 3> means, In<-1, 4> quats, In<-1, 3> log_scales, In<-1> logits, In<-1, -1, -1> sh, float offset,
                bool clamp, In<4, 4> viewmat, std::optional<In<3, 3>> camera, int width, int height, int bases,
                std::optional<In<-1, -1>> extra, bool depth, std::optional<In<-1>> background, float blur,
                std::optional<float> gate, bool normalise, std::vector<bool> in_window, double floor_db, double ceil_db,
                std::optional<In<-1, -1, -1>> added, Out<-1, -1, -1> picture, Out<-1, -1> weight, Out<-1> radii,
                int threads) {
  const size_t count = means.shape(0);
  const int channels = static_cast<int>(sh.shape(2));
  require(quats.shape(0) == count && log_scales.shape(0) == count && logits.shape(0) == count && sh.shape(0) == count &&
              radii.shape(0) == count && channels > 0 && sh.shape(1) == static_cast<size_t>(bases) &&
              (bases == 1 || bases == 4 || bases == 9 || bases == 16),
          "all arrays need one row per Gaussian, harmonics 1, 4, 9 or 16 coefficients");
  const auto wishes = wishes_of(viewmat, camera, width, height, count, channels, extra, depth, background, blur, gate,
                                normalise, in_window, floor_db, ceil_db, added);
  require(picture.shape(0) == static_cast<size_t>(height) && picture.shape(1) == static_cast<size_t>(width) &&
              picture.shape(2) == static_cast<size_t>(wishes->drawing.finishing.channels) &&
              weight.shape(0) == picture.shape(0) && weight.shape(1) == picture.shape(1),
          "outputs do not fit the drawing");
  Shading shading{};
  shading.means = means.data();
  shading.coefficients = sh.data();
  shading.channels = channels;
  shading.bases = bases;
  shading.lanes = channels == 1 && bases != 9 ? bases : 0;
  shading.offset = offset;
  shading.clamp = clamp;
  nb::gil_scoped_release released;
  draw_once(means.data(), quats.data(), log_scales.data(), logits.data(), count, shading, wishes->drawing, threads,
            picture.data(), weight.data(), radii.data());
}

}  // namespace

void bind_trainer(nb::module_& m) {
  m.def("bounds_shape", [](size_t gaussians) { return nb::make_tuple(kBoundColumns, bound_groups(gaussians)); });
  m.def("morton_order", &order_of, "means"_a.noconvert(), "order"_a.noconvert());
  m.def("draw", &draw_plain);
  nb::class_<BoundTrainer>(m, "Trainer", "Gaussians with moments, drawn and moved in one call.")
      .def(nb::init<nb::dict, float, bool, float, float, float, bool>())
      .def("activate", &BoundTrainer::activate)
      .def("draw", &BoundTrainer::draw)
      .def("update", &BoundTrainer::update)
      .def("step", &BoundTrainer::step);
}

}  // namespace rf3dgs
