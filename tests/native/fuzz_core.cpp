// Drives the core over random and hostile scenes, for the sanitizers: fuzz_core [rounds] [seed].
//
// Every array has exactly the size the core may touch. Beyond what a sanitizer sees, each scene must give finite pictures
// and weights between zero and one, hand every visible Gaussian back once, and give the same bits on one and on several
// threads. Ends with 1 and one sentence on standard error at the first law that is broken.
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <cfloat>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <limits>
#include <memory>
#include <random>
#include <stdexcept>
#include <thread>
#include <vector>

#include "core/thread_pool.hpp"
#include "obstacles/obstacles.hpp"
#include "spectra/deposit.hpp"
#include "spectra/responses.hpp"
#include "splats/constants.hpp"
#include "splats/image_loss.hpp"
#include "splats/kernels.hpp"
#include "splats/morton.hpp"
#include "splats/rasterize.hpp"
#include "splats/trainer.hpp"
#include "ways/polarisation.hpp"
#include "ways/reflections.hpp"
#include "ways/ways.hpp"

using namespace rf3dgs;

namespace {

using Floats = std::vector<float>;
std::mt19937 generator;
int round_number = 0;

void require(bool law, const char* sentence) {
  if (law) return;
  std::fprintf(stderr, "round %d: %s\n", round_number, sentence);
  std::exit(1);
}

float uniform(float low, float high) { return std::uniform_real_distribution<float>(low, high)(generator); }
float normal() { return std::normal_distribution<float>()(generator); }
bool chance(float share) { return uniform(0.0f, 1.0f) < share; }
template <class T>
T one_of(std::initializer_list<T> of) {
  return of.begin()[std::uniform_int_distribution<size_t>(0, of.size() - 1)(generator)];
}

float hostile() {
  constexpr float inf = std::numeric_limits<float>::infinity();
  return one_of({NAN, inf, -inf, FLT_MAX, -FLT_MAX, FLT_MIN, 1e-42f, -1e-42f, 0.0f, -0.0f, 1e20f, -1e20f, 1e-20f});
}

bool all_finite(const Floats& values) {
  return std::all_of(values.begin(), values.end(), [](float value) { return std::isfinite(value); });
}

bool same_bits(const Floats& a, const Floats& b) {
  return a.size() == b.size() && (a.empty() || std::memcmp(a.data(), b.data(), a.size() * sizeof(float)) == 0);
}

struct Scattered {
  size_t count;
  int channels;
  Floats means, quats, scales, opacities, offset, values;

  Geometry geometry() const {
    return {means.data(), quats.data(), scales.data(), opacities.data(), offset.empty() ? nullptr : offset.data()};
  }
};

// Gaussians in front of, around, at and behind a viewer at `centre`, some of them spoilt.
Scattered scattered(size_t count, int channels, const float* centre, float spoilt) {
  Scattered of{count, channels, {}, {}, {}, {}, {}, {}};
  const bool shifted = chance(0.3f);
  const float size = std::exp(uniform(-7.0f, 0.0f));
  for (size_t at = 0; at < count; ++at) {
    const float reach = chance(0.05f) ? 0.0f : chance(0.1f) ? 0.05f : 4.0f;
    for (int axis = 0; axis < 3; ++axis) of.means.push_back(centre[axis] + reach * normal());
    for (int part = 0; part < 4; ++part) of.quats.push_back(chance(0.01f) ? 0.0f : normal());
    const int shape = one_of({0, 0, 0, 1, 2, 3});  // any, needle, pancake, point
    for (int axis = 0; axis < 3; ++axis) {
      const float factor = shape == 1 ? (axis == 0 ? 1e3f : 1e-5f) : shape == 2 ? (axis == 0 ? 1e-6f : 1e2f) : 1.0f;
      of.scales.push_back(shape == 3 ? 0.0f : size * factor * std::exp(0.3f * normal()));
    }
    of.opacities.push_back(chance(0.1f) ? uniform(-0.1f, 1.2f) : uniform(0.0f, 1.0f));
    for (int channel = 0; channel < channels; ++channel) of.values.push_back(normal());
    if (shifted) of.offset.insert(of.offset.end(), {normal(), normal()});
  }
  for (Floats* array : {&of.means, &of.quats, &of.scales, &of.opacities, &of.values, &of.offset}) {
    for (float& value : *array) {
      if (chance(spoilt)) value = hostile();
    }
  }
  for (float& value : of.values) {  // products with the largest of floats are infinite by right
    if (std::fabs(value) == FLT_MAX) value = 1e20f;
  }
  for (size_t at = 0; at < count; ++at) {
    if (chance(0.02f)) std::fill_n(of.quats.data() + 4 * at, 4, 0.0f);
  }
  return of;
}

View view_of(Kind kind, int width, int height, const float* centre) {
  View view{};
  view.kind = kind;
  view.width = width;
  view.height = height;
  float q[4] = {normal(), normal(), normal(), normal()};
  const float norm = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]) + 1e-6f;
  for (float& part : q) part /= norm;
  const float w = q[0], x = q[1], y = q[2], z = q[3];
  const float rotation[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z),     2 * (x * z + w * y),
                             2 * (x * y + w * z),     1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                             2 * (x * z - w * y),     2 * (y * z + w * x),     1 - 2 * (x * x + y * y)};
  for (int row = 0; row < 3; ++row) {
    float sum = 0.0f;
    for (int col = 0; col < 3; ++col) {
      view.rotation[3 * row + col] = rotation[3 * row + col];
      sum += rotation[3 * row + col] * centre[col];
    }
    view.translation[row] = -sum;
  }
  view.fx = uniform(0.2f, 2.0f) * static_cast<float>(width);
  view.fy = uniform(0.2f, 2.0f) * static_cast<float>(width);
  view.cx = uniform(0.2f, 0.8f) * static_cast<float>(width);
  view.cy = uniform(0.2f, 0.8f) * static_cast<float>(height);
  view.u_low = -kFieldClamp * view.cx / view.fx;
  view.u_high = kFieldClamp * (static_cast<float>(width) - view.cx) / view.fx;
  view.v_low = -kFieldClamp * view.cy / view.fy;
  view.v_high = kFieldClamp * (static_cast<float>(height) - view.cy) / view.fy;
  return view;
}

// What a rasterization and its way back give.
struct Outcome {
  Floats picture, weight, radii, peaks, values, opacities, means, quats, scales, offset, sphere;
};

template <int Columns>
void put(Floats& to, const float* rows, const uint32_t* sources, size_t count) {
  if (rows == nullptr) return;
  for (size_t at = 0; at < count; ++at) std::copy_n(rows + Columns * at, Columns, &to.at(Columns * sources[at]));
}

Outcome draw_and_return(const Scattered& of, const View& view, const float* background, float gate, Which which,
                        const Floats& picture_gradient, const Floats* weight_gradient, int threads) {
  const size_t pixels = static_cast<size_t>(view.width) * view.height, channels = of.channels;
  Outcome out;
  out.picture.resize(pixels * channels);
  out.weight.resize(pixels);
  out.radii.resize(of.count);
  out.peaks.resize(of.count);
  const auto values_of = [&](size_t begin, size_t end, const uint32_t* sources, float* values) {
    for (size_t at = 0; at < end - begin; ++at) {
      std::copy_n(&of.values.at(sources[at] * channels), channels, values + at * channels);
    }
  };
  const auto scene = rasterize(view, of.count, of.geometry(), of.channels, values_of, background, gate, threads,
                               out.picture.data(), out.weight.data(), out.radii.data(), out.peaks.data());
  out.values.resize(of.count * channels);
  out.opacities.resize(of.count);
  out.means.resize(3 * of.count);
  out.quats.resize(4 * of.count);
  out.scales.resize(3 * of.count);
  out.offset.resize(2 * of.count);
  out.sphere.resize(9 * of.count);
  std::vector<int> taken(of.count, 0);
  const auto take = [&](size_t begin, size_t end, const uint32_t* sources, const float* values, const float* opacity,
                        const GeometryRows* rows) {
    for (size_t at = 0; at < end - begin; ++at) {
      ++taken.at(sources[at]);
      std::copy_n(values + at * channels, channels, &out.values.at(sources[at] * channels));
      out.opacities.at(sources[at]) = opacity[at];
    }
    require((rows != nullptr) == (which == Which::everything), "geometry rows come when they are asked for");
    if (rows == nullptr) return;
    put<3>(out.means, rows->means, sources, end - begin);
    put<4>(out.quats, rows->quats, sources, end - begin);
    put<3>(out.scales, rows->scales, sources, end - begin);
    put<2>(out.offset, rows->offset, sources, end - begin);
    put<9>(out.sphere, rows->sphere, sources, end - begin);
  };
  rasterize_backward(*scene, of.geometry(), out.picture.data(), out.weight.data(), picture_gradient.data(),
                     weight_gradient == nullptr ? nullptr : weight_gradient->data(), which, threads, take);
  size_t visible = 0;
  for (size_t at = 0; at < of.count; ++at) {
    require(taken[at] <= 1, "a Gaussian is handed back at most once");
    require(taken[at] == 1 || out.radii[at] == 0.0f, "a Gaussian that is drawn is handed back");
    visible += taken[at];
  }
  require(visible == scene->visible, "every visible Gaussian is handed back");
  return out;
}

void rasterizer() {
  const float centre[3] = {normal(), normal(), normal()};
  const auto [width, height] = one_of<std::pair<int, int>>(
      {{1, 1}, {1, 7}, {9, 1}, {16, 16}, {17, 33}, {64, 48}, {300, 5}, {2000, 3}, {90, 70}, {15, 200}});
  Kind kind = one_of({Kind::pinhole, Kind::sphere});
  if (kernels().shape[static_cast<int>(kind)].project == nullptr) kind = Kind::pinhole;
  const size_t count = one_of<size_t>({0, 1, 2, 15, 16, 17, 100, 400, 3000});
  const int channels = one_of({1, 1, 2, 3, 3, 4, 5, 6, 7, 8, 9, 17});
  const float spoilt = one_of({0.0f, 0.0f, 0.003f, 0.1f});
  Scattered of = scattered(count, channels, centre, spoilt);
  if (kind == Kind::sphere) of.offset.clear();
  const View view = view_of(kind, width, height, centre);
  Floats background(channels);
  for (float& value : background) value = normal();
  Floats picture_gradient(static_cast<size_t>(width) * height * channels);
  for (float& value : picture_gradient) value = normal();
  Floats weight_gradient(static_cast<size_t>(width) * height);
  for (float& value : weight_gradient) value = normal();
  const float gate = one_of({std::numeric_limits<float>::infinity(), 0.0f, 0.3f});
  const Which which = one_of({Which::appearance, Which::everything});
  const float* behind = chance(0.5f) ? background.data() : nullptr;
  const Floats* of_weight = chance(0.5f) ? &weight_gradient : nullptr;
  const Outcome alone = draw_and_return(of, view, behind, gate, which, picture_gradient, of_weight, 1);
  const Outcome shared = draw_and_return(of, view, behind, gate, which, picture_gradient, of_weight, 3);
  require(all_finite(alone.picture), "the picture is finite");
  for (const float weight : alone.weight) require(weight >= 0.0f && weight <= 1.0f, "weights are shares");
  for (const float peak : alone.peaks) require(peak >= 0.0f && peak <= 1.0f, "largest weights are shares");
  for (const float radius : alone.radii) require(radius >= 0.0f, "radii are not negative");
  require(all_finite(alone.values) && all_finite(alone.opacities), "gradients of values and opacities are finite");
  for (const Floats Outcome::*array :
       {&Outcome::picture, &Outcome::weight, &Outcome::radii, &Outcome::peaks, &Outcome::values, &Outcome::opacities,
        &Outcome::means, &Outcome::quats, &Outcome::scales, &Outcome::offset, &Outcome::sphere}) {
    require(same_bits(alone.*array, shared.*array), "results do not depend on the number of threads");
    if (spoilt == 0.0f) require(all_finite(alone.*array), "gradients of a scene that is not spoilt are finite");
  }
}

void picture_loss() {
  const int width = one_of({1, 2, 5, 11, 16, 17, 40, 130}), height = one_of({1, 2, 5, 11, 16, 33, 60});
  const int channels = one_of({1, 2, 3, 4, 5});
  const size_t pixels = static_cast<size_t>(width) * height;
  Floats picture(pixels * channels), target(pixels * channels), weight(pixels);
  for (float& value : picture) value = chance(0.1f) ? 0.0f : uniform(0.0f, 1.0f);
  for (float& value : target) value = chance(0.1f) ? 0.0f : uniform(0.0f, 1.0f);
  for (float& value : weight) value = chance(0.2f) ? 0.0f : uniform(0.0f, 2.0f);
  weight[0] = 1.0f;
  const float* shares = chance(0.5f) ? weight.data() : nullptr;
  const float similarity = one_of({0.0f, 0.2f, 1.0f});
  const size_t stride = loss_stride(width, channels);
  Floats statistics(2 * height * stride), gradient[2];
  LossTarget compared = {target.data(), shares, nullptr, nullptr, height, width, channels};
  target_statistics(compared, 2, statistics.data(), statistics.data() + height * stride);
  if (chance(0.5f)) {
    compared.mean = statistics.data();
    compared.square = statistics.data() + height * stride;
  }
  double loss[2];
  for (int attempt = 0; attempt < 2; ++attempt) {
    gradient[attempt].resize(pixels * channels);
    LossMemory memory;
    loss[attempt] = l1_ssim(picture.data(), compared, similarity, 1 + 2 * attempt, gradient[attempt].data(), memory);
  }
  require(std::isfinite(loss[0]) && all_finite(gradient[0]), "the loss and its gradient are finite");
  require(loss[0] == loss[1] && same_bits(gradient[0], gradient[1]), "the loss does not depend on the threads");
}

void harmonics() {
  const int bases = one_of({1, 4, 9, 16}), channels = one_of({1, 2, 3, 4, 5, 8});
  const size_t count = one_of<size_t>({1, 2, 15, 16, 17, 50});
  Floats sh(count * bases * channels), directions(3 * count), values(count * channels), back(sh.size());
  for (float& value : sh) value = chance(0.01f) ? hostile() : normal();
  for (float& value : directions) value = chance(0.01f) ? hostile() : normal();
  kernels().harmonics(sh.data(), directions.data(), bases, channels, 0, count, values.data());
  kernels().harmonics_backward(values.data(), directions.data(), bases, channels, 0, count, back.data());
}

// Arrays of a trainer and what it is told about them.
struct School {
  Floats means, quats, log_scales, logits, scales, opacities, sh, base, along, extra, screen, bounds;
  std::vector<Floats> moments;
  std::vector<std::vector<uint16_t>> half_moments;
  std::vector<uint32_t> order;
  Population of{};

  School(const Scattered& from, int lanes, int bases, bool geometry, bool half) {
    const size_t count = from.count, row = static_cast<size_t>(from.channels) * lanes;
    means = from.means;
    quats = from.quats;
    for (const float scale : from.scales) log_scales.push_back(std::log(scale));
    for (const float opacity : from.opacities) logits.push_back(std::log(opacity / (1.0f - opacity)));
    scales.resize(3 * count);
    opacities.resize(count);
    kernels().training.exponentials(log_scales.data(), 3 * count, scales.data());
    kernels().training.sigmoids(logits.data(), count, opacities.data());
    sh.resize(count * row);
    for (float& value : sh) value = 0.3f * normal();
    order.resize(count);
    morton_order(means.data(), count, order.data());
    base.resize(count * from.channels);
    for (float& value : base) value = normal();
    along.resize(from.channels, 0.1f);
    extra.resize(2 * count);
    for (float& value : extra) value = normal();
    screen.resize(3 * count);
    const auto trained = [&](Floats& values) -> Trained {
      if (half) {
        half_moments.emplace_back(values.size(), 0);
        half_moments.emplace_back(values.size(), 0);
        return {values.data(), half_moments[half_moments.size() - 2].data(), half_moments.back().data()};
      }
      moments.emplace_back(values.size(), 0.0f);
      moments.emplace_back(values.size(), 0.0f);
      return {values.data(), moments[moments.size() - 2].data(), moments.back().data()};
    };
    moments.reserve(10);
    half_moments.reserve(10);
    of.count = count;
    of.means = means.data();
    of.quats = quats.data();
    of.scales = scales.data();
    of.opacities = opacities.data();
    of.sh = sh.data();
    if (!geometry) {
      bounds.resize(kBoundColumns * bound_groups(count));
      kernels().bound(means.data(), scales.data(), count, 0, bound_groups(count), bounds.data());
      of.bounds = bounds.data();
    }
    if (geometry) {
      of.trained_means = trained(means);
      of.trained_quats = trained(quats);
      of.trained_log_scales = trained(log_scales);
      of.screen = screen.data();
    }
    of.trained_logits = trained(logits);
    of.trained_sh = trained(sh);
    of.order = order.data();
    of.channels = from.channels;
    of.lanes = lanes;
    of.bases = bases;
    of.beta1 = 0.9f;
    of.beta2 = 0.99f;
    of.eps = 1e-15f;
    of.half_moments = half;
  }
};

// A few steps on one and on several threads end with the same bits, and leave what no view shows as it was.
void trainer() {
  const float centre[3] = {normal(), normal(), normal()};
  const auto [width, height] = one_of<std::pair<int, int>>({{1, 1}, {17, 33}, {64, 48}, {40, 3}});
  Kind kind = one_of({Kind::pinhole, Kind::pinhole, Kind::sphere});
  if (kernels().shape[static_cast<int>(kind)].project == nullptr) kind = Kind::pinhole;
  const int lanes = one_of({1, 4, 16}), bases = lanes == 16 ? one_of({1, 4, 9, 16}) : lanes;
  const bool geometry = chance(0.5f) && kind == Kind::pinhole, half = chance(0.5f), extra = chance(0.4f);
  const bool depth = chance(0.4f), base = chance(0.3f), clamp = chance(0.5f);
  const int channels = one_of({1, 2, 3, 4, 5});
  const size_t count = one_of<size_t>({0, 1, 17, 200, 3000});
  const Scattered from = scattered(count, channels, centre, one_of({0.0f, 0.0f, 0.003f}));
  School schools[2] = {{from, lanes, bases, geometry, half}, {from, lanes, bases, geometry, half}};
  schools[1].sh = schools[0].sh;
  schools[1].base = schools[0].base;
  schools[1].extra = schools[0].extra;
  Drawing drawing{};
  drawing.view = view_of(kind, width, height, centre);
  drawing.extras = extra ? 2 : 0;
  drawing.depth = depth;
  drawing.gate = one_of({std::numeric_limits<float>::infinity(), 0.3f});
  const int shown = channels + drawing.extras + depth;
  const size_t pixels = static_cast<size_t>(width) * height;
  std::vector<uint8_t> in_window(shown, chance(0.3f));
  drawing.finishing = {shown, chance(0.3f), in_window[0] ? in_window.data() : nullptr, 1e4f, 0.1f};
  Floats added(pixels * shown, 0.1f), target(pixels * shown), weight(pixels, 1.0f), rate(channels * lanes, 1e-2f);
  if (chance(0.3f)) drawing.added = added.data();
  for (float& value : target) value = uniform(0.0f, 1.0f);
  const LossTarget compared = {target.data(), chance(0.5f) ? weight.data() : nullptr, nullptr, nullptr, height, width, shown};
  double loss[2] = {};
  for (int attempt = 0; attempt < 2; ++attempt) {
    School& school = schools[attempt];
    school.of.clamp = clamp;
    school.of.base = base ? school.base.data() : nullptr;
    school.of.along = base ? school.along.data() : nullptr;
    drawing.extra = extra ? school.extra.data() : nullptr;
    Trainer trainer;
    for (int step = 1; step <= 3; ++step) {
      const Rates rates = {1e-3f, 1e-3f, 1e-3f, 1e-2f, rate.data(), 0.01f, step};
      loss[attempt] = trainer.step(school.of, drawing, compared, 0.2f, rates, 1 + 2 * attempt);
      if (step > 1) continue;
      for (size_t at = 0; at < count; ++at) {
        if (trainer.radii()[at] > 0.0f || std::isnan(school.logits[at])) continue;
        const float opacity = from.opacities[at];
        require(school.logits[at] == std::log(opacity / (1.0f - opacity)), "what is not drawn is not moved");
      }
    }
  }
  require(std::memcmp(loss, loss + 1, sizeof(double)) == 0, "a loss does not depend on the number of threads");
  for (const Floats School::*array : {&School::means, &School::quats, &School::log_scales, &School::logits, &School::sh,
                                      &School::scales, &School::opacities, &School::screen}) {
    require(same_bits(schools[0].*array, schools[1].*array), "training does not depend on the number of threads");
  }
}

// Several callers at once, loops that throw, more threads than work.
void pool() {
  std::vector<std::thread> callers;
  std::vector<int> sums(3, 0);
  for (int caller = 0; caller < 3; ++caller) {
    callers.emplace_back([caller, &sums] {
      std::vector<int> seen(50, 0);
      for (int repeat = 0; repeat < 5; ++repeat) parallel_for(50, 4, [&](int index) { ++seen[index]; });
      for (const int count : seen) sums[caller] += count;
    });
  }
  for (std::thread& caller : callers) caller.join();
  for (const int sum : sums) require(sum == 250, "every index is worked on once");
  bool thrown = false;
  try {
    parallel_for(20, 3, [](int index) {
      if (index % 7 == 3) throw std::runtime_error("expected");
    });
  } catch (const std::runtime_error&) {
    thrown = true;
  }
  require(thrown, "what a worker throws reaches the caller");
  parallel_for(0, 3, [](int) { std::abort(); });
}

// A child of a process whose pool is running draws too.
void fork_and_draw() {
  std::fflush(nullptr);
  const pid_t child = fork();
  if (child == 0) {
    rasterizer();
    pool();
    _exit(0);
  }
  int status = 0;
  require(child > 0 && waitpid(child, &status, 0) == child && status == 0, "a forked child draws");
}

// Most of a picture larger than any cache is empty.
void large_picture() {
  const float centre[3] = {};
  const Scattered of = scattered(50, 1, centre, 0.05f);
  const View view = view_of(Kind::pinhole, 2048, 1030, centre);
  const size_t pixels = static_cast<size_t>(view.width) * view.height;
  const Outcome out = draw_and_return(of, view, nullptr, std::numeric_limits<float>::infinity(), Which::everything,
                                      Floats(pixels, 1.0f), nullptr, 2);
  require(all_finite(out.picture), "a large picture is finite");
}

// Paths of spectra: some with hostile places and directions. Gains are conserved where all numbers are numbers, and one
// thread and several give the same bits.
void sums_over_paths() {
  const bool tame = chance(0.5f);
  const size_t count = one_of<size_t>({0, 1, 7, 500, 40000});
  const auto number = [&] { return !tame && chance(0.01f) ? hostile() : normal(); };
  const int rows = one_of({2, 7, 8, 9, 33}), columns = one_of({2, 12, 35}), fold = one_of({0, 1, 3});
  Floats directions(3 * count), gain(count), delay(count), departures(3 * count);
  for (Floats* values : {&directions, &delay, &departures}) std::generate(values->begin(), values->end(), number);
  for (float& value : gain) value = chance(0.2f) ? 0.0f : std::abs(normal());
  const ArrivingPaths arriving{directions.data(), gain.data(), delay.data(), departures.data()};
  const size_t nodes = static_cast<size_t>(rows) * columns;
  std::vector<double> once(kDepositChannels * nodes), again(once);
  deposit_paths(arriving, count, rows, columns, fold, once.data(), 1);
  deposit_paths(arriving, count, rows, columns, fold, again.data(), 3);
  require(std::memcmp(once.data(), again.data(), once.size() * sizeof(double)) == 0, "deposits differ between threads");
  double there = 0.0, given = 0.0;
  for (size_t node = 0; node < nodes; ++node) there += once[node];
  for (float value : gain) given += value;
  require(std::abs(there - given) <= 1e-9 * (1.0 + given), "a deposit loses gain");

  const int array_rows = one_of({1, 3, 8}), array_cols = one_of({1, 2, 5}), cells = one_of({2, 14, 40, 512});
  std::vector<double> coeff(2 * count), place(count), towards(3 * count), polynomials(kSpreadTerms * kSpreadColumns);
  for (std::vector<double>* values : {&coeff, &towards}) std::generate(values->begin(), values->end(), number);
  for (double& value : place) value = !tame && chance(0.01f) ? hostile() : uniform(0.0f, 1.0f) * cells;
  for (int tap = 0; tap < kSpreadWidth; ++tap) polynomials[(kSpreadTerms - 1) * kSpreadColumns + tap] = 1.0;
  const PathWaves waves{coeff.data(), place.data(), towards.data(), polynomials.data(), 3.1, -3.2, array_rows, array_cols};
  const size_t elements = static_cast<size_t>(array_rows) * array_cols;
  std::vector<double> total(2 * elements * cells, 0.0), repeated(total);
  spread_responses(waves, count, cells, total.data(), 1);
  spread_responses(waves, count, cells, repeated.data(), 3);
  require(std::memcmp(total.data(), repeated.data(), total.size() * sizeof(double)) == 0, "responses differ");
}

// Segments through hostile Gaussians: what passes is a share, and the same on one thread and on several.
void segments() {
  const float centre[3] = {normal(), normal(), normal()};
  const Scattered of = scattered(one_of<size_t>({0, 1, 15, 16, 17, 257, 5000}), 1, centre, one_of({0.0f, 0.01f, 0.2f}));
  std::vector<int32_t> labels(of.count);
  for (int32_t& label : labels) label = one_of({INT32_MIN, -1, 0, 1, INT32_MAX - 1});
  const Obstacles obstacles(of.means.data(), of.quats.data(), of.scales.data(), of.opacities.data(),
                            chance(0.7f) ? labels.data() : nullptr, of.count, one_of({0.3f, 0.0f, NAN}));
  require(obstacles.size() <= of.count, "no Gaussian is made up");
  const size_t count = one_of<size_t>({0, 1, 63, 64, 65, 300});
  Floats start(3 * count), end(3 * count), once(count), again(count);
  for (Floats* points : {&start, &end}) {
    for (size_t at = 0; at < 3 * count; ++at) {
      (*points)[at] = chance(0.01f) ? hostile() : centre[at % 3] + (chance(0.2f) ? 0.0f : 4.0f * normal());
    }
  }
  std::vector<int32_t> skip(count);
  for (int32_t& label : skip) label = one_of({INT32_MIN, -2, -1, 0, 1, INT32_MAX});
  const Segments asked{start.data(), end.data(), chance(0.5f) ? skip.data() : nullptr,
                       chance(0.5f) ? skip.data() : nullptr, one_of({0.0f, 0.1f, 1e9f})};
  obstacles.transmittance(asked, count, 1, once.data());
  obstacles.transmittance(asked, count, 3, again.data());
  for (const float share : once) require(share >= 0.0f && share <= 1.0f, "what passes is a share");
  require(same_bits(once, again), "what passes does not depend on the number of threads");
}

// Doubles about zero, some of them spoilt.
std::vector<double> drawn(size_t size, double spread) {
  std::vector<double> values(size);
  for (double& value : values) value = chance(0.02f) ? hostile() : spread * normal();
  return values;
}

void ways() {
  const int64_t planes = one_of<int64_t>({1, 2, 6}), sources = one_of<int64_t>({1, 7, 40});
  const size_t count = one_of<size_t>({0, 1, 63, 65, 200});
  const auto chain = drawn(12 * sources, 5.0), normals = drawn(3 * (planes + 1), 1.0), offsets = drawn(planes + 1, 3.0);
  const auto side = drawn(sources, 3.0), axes = drawn(6 * planes, 5.0), low = drawn(2 * planes, 9.0);
  const auto receivers = drawn(3 * count, 5.0);
  std::vector<int64_t> sequence(3 * sources, -1), order(sources), last(sources, -1), wide(planes), start(planes);
  for (int64_t source = 0; source < sources; ++source) {
    order[source] = one_of<int64_t>({0, 1, 2, 3});
    for (int64_t step = 0; step < order[source]; ++step) {
      last[source] = sequence[3 * source + step] = static_cast<int64_t>(generator() % planes);
    }
  }
  std::vector<double> edge(2 * planes);
  int64_t cells = 0;
  for (int64_t plane = 0; plane < planes; ++plane) {
    const int64_t rows = one_of<int64_t>({1, 5, 40});
    wide[plane] = one_of<int64_t>({1, 8, 30});
    start[plane] = cells;
    edge[2 * plane] = static_cast<double>(rows - 1);
    edge[2 * plane + 1] = static_cast<double>(wide[plane] - 1);
    cells += rows * wide[plane];
  }
  const auto surface = std::make_unique<bool[]>(cells);
  for (int64_t cell = 0; cell < cells; ++cell) surface[cell] = chance(0.8f);
  const auto asked = std::make_unique<bool[]>(sources);
  for (int64_t source = 0; source < sources; ++source) asked[source] = chance(0.8f);
  const WayPlan plan{chain.data(), sequence.data(), order.data(), last.data(), side.data(), normals.data(),
                     offsets.data(), chance(0.7f) ? axes.data() : nullptr, low.data(), edge.data(), wide.data(),
                     start.data(), surface.get(), sources, planes};
  const bool* wanted = chance(0.5f) ? asked.get() : nullptr;
  const auto once = fold_ways(plan, receivers.data(), count, wanted, 1);
  const auto again = fold_ways(plan, receivers.data(), count, wanted, 3);
  require(once.size() == again.size() &&
              (once.empty() || std::memcmp(once.data(), again.data(), once.size() * sizeof(Way)) == 0),
          "ways do not depend on the number of threads");
  for (size_t at = 0; at < once.size(); ++at) {
    require(once[at].place < static_cast<int64_t>(count) && once[at].source < sources, "no way is made up");
    require(at == 0 || once[at - 1].place < once[at].place ||
                (once[at - 1].place == once[at].place && once[at - 1].source < once[at].source),
            "ways are sorted by receiver and source");
    require(wanted == nullptr || wanted[once[at].source], "only sources that are asked have ways");
  }
}

void reflections() {
  const int64_t planes = one_of<int64_t>({1, 2, 6}), marks = one_of<int64_t>({0, 1, 40, 900});
  const size_t count = one_of<size_t>({0, 1, 63, 65, 300});
  const auto laws = drawn(3 * planes, 5.0), ripple = drawn(kRipple * planes, 3.0);
  const auto places = drawn(3 * marks, 2.0), along = drawn(marks, 2.0);
  const auto level_db = drawn(marks, 9.0), cosine = drawn(kMostReflections * count, 0.5);
  const auto points = drawn(3 * kMostReflections * count, 2.0);
  std::vector<int64_t> start(planes + 1, 0), met(kMostReflections * count);
  for (int64_t plane = 1; plane < planes; ++plane) start[plane] = static_cast<int64_t>(generator() % (marks + 1));
  start[planes] = marks;
  std::sort(start.begin(), start.end());
  for (int64_t& plane : met) plane = static_cast<int64_t>(generator() % (planes + 1)) - 1;
  const ReflectionTable table{laws.data(),     ripple.data(), places.data(), along.data(),
                              level_db.data(), start.data(),  one_of({1e-300, 0.15, 3.0, 1e300})};
  std::vector<double> once(count), again(count);
  reflect(table, met.data(), cosine.data(), points.data(), count, 1, once.data());
  reflect(table, met.data(), cosine.data(), points.data(), count, 3, again.data());
  require(count == 0 || std::memcmp(once.data(), again.data(), count * sizeof(double)) == 0,
          "reflections do not depend on the number of threads");
  for (const double sum_db : once) require(!(sum_db > 0.0), "no reflection gains power");
}

void polarisation() {
  const int64_t planes = one_of<int64_t>({1, 2, 6});
  const size_t count = one_of<size_t>({0, 1, 63, 65, 300});
  const auto normals = drawn(3 * planes, 1.0), slabs = drawn(3 * planes, 4.0);
  const auto cosine = drawn(kMostReflections * count, 0.5), departure = drawn(3 * count, 1.0);
  std::vector<int64_t> met(kMostReflections * count);
  for (int64_t& plane : met) plane = static_cast<int64_t>(generator() % (planes + 1)) - 1;
  const SlabTable table{normals.data(), slabs.data()};
  std::vector<double> once(count), again(count);
  keep(table, met.data(), cosine.data(), departure.data(), count, 1, once.data());
  keep(table, met.data(), cosine.data(), departure.data(), count, 3, again.data());
  require(count == 0 || std::memcmp(once.data(), again.data(), count * sizeof(double)) == 0,
          "polarisation does not depend on the number of threads");
}

}  // namespace

int main(int count, char** words) {
  const int rounds = count > 1 ? std::atoi(words[1]) : 200;
  const unsigned seed = count > 2 ? std::strtoul(words[2], nullptr, 10) : 0;
  const bool forks = std::getenv("RF3DGS_FUZZ_NO_FORK") == nullptr;
  for (round_number = 0; round_number < rounds; ++round_number) {
    generator.seed(seed + round_number);
    rasterizer();
    picture_loss();
    harmonics();
    trainer();
    sums_over_paths();
    segments();
    ways();
    reflections();
    polarisation();
    if (round_number % 10 == 0) pool();
    if (round_number % 25 == 5 && forks) fork_and_draw();
  }
  large_picture();
  std::printf("fuzz_core: %d rounds with %s, no complaint\n", rounds, kernels().name);
  return 0;
}
