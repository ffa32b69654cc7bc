// What Python sees of the picture loss.
#include "bind_loss.hpp"

namespace rf3dgs {
namespace {

using namespace nb::literals;

using Statistics = Out<2, -1, -1>;

double picture_loss(In<-1, -1, -1> picture, In<-1, -1, -1> target, std::optional<In<-1, -1>> weight, float ssim_weight,
                    std::optional<In<2, -1, -1>> statistics, std::optional<Out<-1, -1, -1>> gradient, int threads) {
  const LossTarget compared = target_of(target, weight, statistics);
  require(fits(compared, picture) && (!gradient || fits(compared, *gradient)), "pictures do not have one shape");
  nb::gil_scoped_release released;
  LossMemory memory;
  return l1_ssim(picture.data(), compared, ssim_weight, threads, data_or_null(gradient), memory);
}

void statistics_of_target(In<-1, -1, -1> target, Statistics out, int threads) {
  const LossTarget compared = target_of(target, std::nullopt, In<2, -1, -1>(out));
  nb::gil_scoped_release released;
  target_statistics(compared, threads, out.data(), out.data() + out.size() / 2);
}

}  // namespace

void bind_loss(nb::module_& m) {
  m.def("loss_stride", &loss_stride, "width"_a, "channels"_a);
  m.def("target_statistics", &statistics_of_target, "target"_a.noconvert(), "out"_a.noconvert(), "threads"_a);
  m.def("l1_ssim", &picture_loss, "picture"_a.noconvert(), "target"_a.noconvert(), "weight"_a.noconvert().none(),
        "ssim_weight"_a, "statistics"_a.noconvert().none(), "gradient"_a.noconvert().none(), "threads"_a);
}

}  // namespace rf3dgs
