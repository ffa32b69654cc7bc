// The table of one instruction set; RF3DGS_KERNELS names the function that returns it.
#pragma once

#include "splats/kernels_adam.hpp"
#include "splats/kernels_bounds.hpp"
#include "splats/kernels_compositing.hpp"
#include "splats/kernels_harmonics.hpp"
#include "splats/kernels_loss.hpp"
#include "splats/kernels_pinhole.hpp"
#include "splats/kernels_shade.hpp"
#include "splats/kernels_shapes.hpp"
#include "splats/kernels_sphere.hpp"

#define RF3DGS_DEFINE_KERNELS(function, name)                                                                  \
  namespace rf3dgs {                                                                                           \
  const Kernels& function() {                                                                                  \
    static constexpr Kernels table = {name, {pinhole_kernels(), sphere_kernels()},                              \
                                      ::bound, ::harmonics, ::harmonics_backward,                              \
                                      ::ssim_rows, ::ssim_gradient_rows, ::l1_rows, ::l1_gradient_rows,        \
                                      ::target_rows,                                                           \
                                      {::shade, ::shade_plain, ::update_harmonics, ::update_shapes,           \
                                       ::exponentials, ::sigmoids, ::finish, ::finish_backward}};             \
    return table;                                                                                              \
  }                                                                                                            \
  }
