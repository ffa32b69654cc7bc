// What the binding files share: arrays are float32, C-contiguous, on the CPU and never converted.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <limits>
#include <optional>
#include <stdexcept>

#include "splats/kernels.hpp"

namespace rf3dgs {

namespace nb = nanobind;

template <int... Shape>
using In = nb::ndarray<const float, nb::shape<Shape...>, nb::c_contig, nb::device::cpu>;
template <int... Shape>
using Out = nb::ndarray<float, nb::shape<Shape...>, nb::c_contig, nb::device::cpu>;

inline void require(bool fine, const char* message) {
  if (!fine) throw std::invalid_argument(message);
}

template <class Array>
auto* data_or_null(const std::optional<Array>& array) {
  return array ? array->data() : nullptr;
}

// A pinhole camera, or without a camera matrix the whole sphere.
inline View view_of(const In<4, 4>& viewmat, const std::optional<In<3, 3>>& camera, int width, int height,
                    float blur) {
  require(width > 0 && height > 0, "a picture needs at least one pixel each way");
  require(blur > 0.0f && blur < std::numeric_limits<float>::infinity(), "the blur is a positive number of pixels^2");
  View view{};
  view.kind = camera ? Kind::pinhole : Kind::sphere;
  view.width = width;
  view.height = height;
  view.blur = blur;
  const float* m = viewmat.data();
  for (int row = 0; row < 3; ++row) {
    for (int col = 0; col < 3; ++col) view.rotation[3 * row + col] = m[4 * row + col];
    view.translation[row] = m[4 * row + 3];
  }
  if (!camera) return view;
  const float* k = camera->data();
  view.fx = k[0];
  view.fy = k[4];
  view.cx = k[2];
  view.cy = k[5];
  view.u_low = -kFieldClamp * view.cx / view.fx;
  view.u_high = kFieldClamp * (width - view.cx) / view.fx;
  view.v_low = -kFieldClamp * view.cy / view.fy;
  view.v_high = kFieldClamp * (height - view.cy) / view.fy;
  return view;
}

void bind_loss(nb::module_& m);
void bind_obstacles(nb::module_& m);
void bind_trainer(nb::module_& m);
void bind_ways(nb::module_& m);

}  // namespace rf3dgs
