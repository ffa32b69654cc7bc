// What Python sees. Arrays are float32, C-contiguous, on the CPU and never converted: the Python side prepares them and
// checks shapes, this file only refuses what could read past an end. The GIL is released while the core works.
#include <nanobind/stl/unique_ptr.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <stdexcept>
#include <thread>

#include "bind.hpp"
#include "bind_floor.hpp"
#include "bind_spectra.hpp"
#include "core/thread_pool.hpp"
#include "splats/constants.hpp"
#include "splats/kernels.hpp"
#include "splats/rasterize.hpp"

using namespace rf3dgs;
using namespace nb::literals;

namespace {

Geometry geometry_of(const In<-1, 3>& means, const In<-1, 4>& quats, const In<-1, 3>& scales, const In<-1>& opacities,
                     const std::optional<In<-1, 2>>& offset) {
  const size_t count = means.shape(0);
  require(quats.shape(0) == count && scales.shape(0) == count && opacities.shape(0) == count &&
              (!offset || offset->shape(0) == count),
          "all arrays need one row per Gaussian");
  require(count < (size_t{1} << 31), "too many Gaussians");
  return {means.data(), quats.data(), scales.data(), opacities.data(), data_or_null(offset)};
}

std::unique_ptr<Scene> forward(In<-1, 3> means, In<-1, 4> quats, In<-1, 3> scales, In<-1> opacities, In<-1, -1> values,
                               In<4, 4> viewmat, std::optional<In<3, 3>> camera, std::optional<In<-1>> background,
                               std::optional<In<-1, 2>> offset, float blur, std::optional<float> gate,
                               Out<-1, -1, -1> picture, Out<-1, -1> weight, Out<-1> radii,
                               std::optional<Out<-1>> max_weight, int threads) {
  const Geometry geometry = geometry_of(means, quats, scales, opacities, offset);
  const size_t count = means.shape(0), channels = values.shape(1);
  const size_t height = picture.shape(0), width = picture.shape(1);
  require(values.shape(0) == count && channels > 0, "values need one row per Gaussian and at least one channel");
  require(picture.shape(2) == channels && weight.shape(0) == height && weight.shape(1) == width &&
              radii.shape(0) == count && (!background || background->shape(0) == channels) &&
              (!max_weight || max_weight->shape(0) == count),
          "outputs do not fit the inputs");
  require(!gate || *gate >= 0.0f, "the gate is a distance");
  const View view = view_of(viewmat, camera, static_cast<int>(width), static_cast<int>(height), blur);
  const float* const all_values = values.data();
  const auto values_of = [=](size_t begin, size_t end, const uint32_t* sources, float* to) {
    for (size_t at = 0; at < end - begin; ++at) {
      std::copy_n(all_values + sources[at] * channels, channels, to + at * channels);
    }
  };
  nb::gil_scoped_release released;
  return rasterize(view, count, geometry, static_cast<int>(channels), values_of, data_or_null(background),
                   gate.value_or(std::numeric_limits<float>::infinity()), threads, picture.data(), weight.data(),
                   radii.data(), data_or_null(max_weight));
}

template <int Columns>
void scatter(const float* rows, const uint32_t* sources, size_t count, float* to) {
  for (size_t at = 0; at < count; ++at) {
    std::copy_n(rows + at * Columns, Columns, to + static_cast<size_t>(sources[at]) * Columns);
  }
}

void backward(Scene& scene, In<-1, 3> means, In<-1, 4> quats, In<-1, 3> scales, In<-1> opacities,
              std::optional<In<-1, 2>> offset, In<-1, -1, -1> picture, In<-1, -1> weight,
              In<-1, -1, -1> picture_gradient, std::optional<In<-1, -1>> weight_gradient,
              std::optional<Out<-1, -1>> values_gradient, std::optional<Out<-1>> opacities_gradient,
              std::optional<Out<-1, 3>> means_gradient, std::optional<Out<-1, 4>> quats_gradient,
              std::optional<Out<-1, 3>> scales_gradient, std::optional<Out<-1, 2>> offset_gradient,
              std::optional<Out<-1, 9>> sphere_gradient, int threads) {
  const Geometry geometry = geometry_of(means, quats, scales, opacities, offset);
  const size_t height = scene.view.height, width = scene.view.width, channels = scene.channels;
  const auto is_picture = [&](const In<-1, -1, -1>& array) {
    return array.shape(0) == height && array.shape(1) == width && array.shape(2) == channels;
  };
  const auto is_map = [&](const In<-1, -1>& array) { return array.shape(0) == height && array.shape(1) == width; };
  const auto fits = [&](const auto& array) { return !array || array->shape(0) == scene.gaussians; };
  require(means.shape(0) == scene.gaussians && is_picture(picture) && is_picture(picture_gradient) &&
              is_map(weight) && (!weight_gradient || is_map(*weight_gradient)) && fits(values_gradient) &&
              (!values_gradient || values_gradient->shape(1) == channels) && fits(opacities_gradient) &&
              fits(means_gradient) && fits(quats_gradient) && fits(scales_gradient) && fits(offset_gradient) &&
              fits(sphere_gradient),
          "gradients do not fit the scene");
  float* const to_values = data_or_null(values_gradient);
  float* const to_opacities = data_or_null(opacities_gradient);
  float* const to_means = data_or_null(means_gradient);
  float* const to_quats = data_or_null(quats_gradient);
  float* const to_scales = data_or_null(scales_gradient);
  float* const to_offset = data_or_null(offset_gradient);
  float* const to_sphere = data_or_null(sphere_gradient);
  const bool flat = to_means != nullptr || to_quats != nullptr || to_scales != nullptr || to_offset != nullptr;
  require(!(scene.view.kind == Kind::sphere ? flat : to_sphere != nullptr), "these gradients belong to another view");
  const bool any = flat || to_sphere != nullptr;
  const auto take = [=](size_t begin, size_t end, const uint32_t* sources, const float* values, const float* opacity,
                        const GeometryRows* rows) {
    const size_t count = end - begin;
    for (size_t at = 0; at < count && to_values != nullptr; ++at) {
      std::copy_n(values + at * channels, channels, to_values + sources[at] * channels);
    }
    if (to_opacities != nullptr) scatter<1>(opacity, sources, count, to_opacities);
    if (to_means != nullptr) scatter<3>(rows->means, sources, count, to_means);
    if (to_quats != nullptr) scatter<4>(rows->quats, sources, count, to_quats);
    if (to_scales != nullptr) scatter<3>(rows->scales, sources, count, to_scales);
    if (to_offset != nullptr) scatter<2>(rows->offset, sources, count, to_offset);
    if (to_sphere != nullptr) scatter<9>(rows->sphere, sources, count, to_sphere);
  };
  nb::gil_scoped_release released;
  rasterize_backward(scene, geometry, picture.data(), weight.data(), picture_gradient.data(),
                     data_or_null(weight_gradient), any ? Which::everything : Which::appearance, threads, take);
}

constexpr size_t kHarmonicsChunk = 4096;

void harmonics_forward(In<-1, -1, -1> sh, In<-1, 3> directions, Out<-1, -1> out, int threads) {
  const size_t count = sh.shape(0), bases = sh.shape(1), channels = sh.shape(2);
  require(bases == 1 || bases == 4 || bases == 9 || bases == 16, "harmonics have 1, 4, 9 or 16 coefficients");
  require(directions.shape(0) == count && out.shape(0) == count && out.shape(1) == channels, "shapes do not fit");
  nb::gil_scoped_release released;
  const int chunks = static_cast<int>((count + kHarmonicsChunk - 1) / kHarmonicsChunk);
  parallel_for(chunks, threads, [&](int chunk) {
    const size_t begin = chunk * kHarmonicsChunk, end = std::min(count, begin + kHarmonicsChunk);
    kernels().harmonics(sh.data(), directions.data(), static_cast<int>(bases), static_cast<int>(channels), begin, end,
                        out.data());
  });
}

void harmonics_backward(In<-1, -1> gradient, In<-1, 3> directions, Out<-1, -1, -1> out, int threads) {
  const size_t count = out.shape(0), bases = out.shape(1), channels = out.shape(2);
  require(bases == 1 || bases == 4 || bases == 9 || bases == 16, "harmonics have 1, 4, 9 or 16 coefficients");
  require(directions.shape(0) == count && gradient.shape(0) == count && gradient.shape(1) == channels,
          "shapes do not fit");
  nb::gil_scoped_release released;
  const int chunks = static_cast<int>((count + kHarmonicsChunk - 1) / kHarmonicsChunk);
  parallel_for(chunks, threads, [&](int chunk) {
    const size_t begin = chunk * kHarmonicsChunk, end = std::min(count, begin + kHarmonicsChunk);
    kernels().harmonics_backward(gradient.data(), directions.data(), static_cast<int>(bases),
                                 static_cast<int>(channels), begin, end, out.data());
  });
}

}  // namespace

NB_MODULE(_native, m) {
  // Autograd contexts that live until the interpreter ends may still hold a Scene.
  nb::set_leak_warnings(false);
  m.doc() = "The native core of rf3dgs: rasterizer, spherical harmonics and picture loss on the CPU.";

  m.def(
      "info",
      [] {
        nb::dict result;
        result["instruction_set"] = kernels().name;
        result["threads"] = std::max(1u, std::thread::hardware_concurrency());
        return result;
      },
      "The instruction set in use and the number of hardware threads.");
  m.def(
      "constants",
      [] {
        nb::dict result;
        result["ALPHA_MAX"] = kAlphaMax;
        result["ALPHA_MIN"] = kAlphaMin;
        result["TRANSMITTANCE_STOP"] = kTransmittanceStop;
        result["BLUR"] = kBlur;
        result["NEAR"] = kNear;
        result["FIELD_CLAMP"] = kFieldClamp;
        result["GATE_TRANSMITTANCE"] = kGateTransmittance;
        result["SPHERE_FIELD"] = kSphereField;
        result["SSIM_RADIUS"] = kSsimRadius;
        result["SSIM_SIGMA"] = kSsimSigma;
        result["SSIM_C1"] = kSsimC1;
        result["SSIM_C2"] = kSsimC2;
        return result;
      },
      "The rasterizer's numbers by the names of splats/constants.py.");

  nb::class_<Scene>(m, "Scene", "What the backward pass needs of a forward pass.")
      .def_prop_ro("visible", [](const Scene& scene) { return scene.visible; })
      .def_prop_ro("entries", [](const Scene& scene) { return scene.entries; })
      .def_prop_ro("pairs", [](const Scene& scene) { return scene.pairs(); });

  m.def("rasterize", &forward, nb::arg("means").noconvert(), nb::arg("quats").noconvert(),
        nb::arg("scales").noconvert(), nb::arg("opacities").noconvert(), nb::arg("values").noconvert(),
        nb::arg("viewmat").noconvert(), nb::arg("camera").noconvert().none(), nb::arg("background").noconvert().none(),
        nb::arg("offset").noconvert().none(), nb::arg("blur"), nb::arg("gate").none(), nb::arg("picture").noconvert(),
        nb::arg("weight").noconvert(), nb::arg("radii").noconvert(), nb::arg("max_weight").noconvert().none(),
        nb::arg("threads"));
  m.def("rasterize_backward", &backward, nb::arg("scene"), nb::arg("means").noconvert(), nb::arg("quats").noconvert(),
        nb::arg("scales").noconvert(), nb::arg("opacities").noconvert(), nb::arg("offset").noconvert().none(),
        nb::arg("picture").noconvert(), nb::arg("weight").noconvert(), nb::arg("picture_gradient").noconvert(), nb::arg("weight_gradient").noconvert().none(),
        nb::arg("values_gradient").noconvert().none(), nb::arg("opacities_gradient").noconvert().none(),
        nb::arg("means_gradient").noconvert().none(), nb::arg("quats_gradient").noconvert().none(),
        nb::arg("scales_gradient").noconvert().none(), nb::arg("offset_gradient").noconvert().none(),
        nb::arg("sphere_gradient").noconvert().none(), nb::arg("threads"));
  m.def("harmonics_forward", &harmonics_forward, nb::arg("sh").noconvert(), nb::arg("directions").noconvert(),
        nb::arg("out").noconvert(), nb::arg("threads"));
  m.def("harmonics_backward", &harmonics_backward, nb::arg("gradient").noconvert(), nb::arg("directions").noconvert(),
        nb::arg("out").noconvert(), nb::arg("threads"));
  bind_loss(m);
  bind_obstacles(m);
  bind_trainer(m);
  bind_ways(m);
  bind_floor(m);
  bind_spectra(m);
}
