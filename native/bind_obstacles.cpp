// What Python sees of Gaussians as obstacles: arrays are C-contiguous, on the CPU and never converted.
#include "obstacles/obstacles.hpp"

#include <cmath>

#include "bind.hpp"

namespace rf3dgs {
namespace {

using namespace nb::literals;

using Labels = nb::ndarray<const int32_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;

}  // namespace

void bind_obstacles(nb::module_& m) {
  nb::class_<Obstacles>(m, "Obstacles", "Gaussians in a tree, asked for what passes along segments.")
      .def(
          "__init__",
          [](Obstacles* self, In<-1, 3> means, In<-1, 4> quats, In<-1, 3> scales, In<-1> opacities,
             std::optional<Labels> labels, float min_opacity) {
            const size_t count = means.shape(0);
            require(quats.shape(0) == count && scales.shape(0) == count && opacities.shape(0) == count &&
                        (!labels || labels->shape(0) == count) && count < (size_t{1} << 31),
                    "all arrays need one row per Gaussian");
            nb::gil_scoped_release released;
            new (self) Obstacles(means.data(), quats.data(), scales.data(), opacities.data(), data_or_null(labels),
                                 count, min_opacity);
          },
          "means"_a.noconvert(), "quats"_a.noconvert(), "scales"_a.noconvert(), "opacities"_a.noconvert(),
          "labels"_a.noconvert().none(), "min_opacity"_a)
      .def("__len__", &Obstacles::size)
      .def(
          "transmittance",
          [](const Obstacles& self, In<-1, 3> start, In<-1, 3> end, std::optional<Labels> skip_start,
             std::optional<Labels> skip_end, float stop_short, Out<-1> out, int threads) {
            const size_t count = start.shape(0);
            require(end.shape(0) == count && out.shape(0) == count && (!skip_start || skip_start->shape(0) == count) &&
                        (!skip_end || skip_end->shape(0) == count),
                    "all arrays need one row per segment");
            require(std::isfinite(stop_short), "what is cut off is a length");
            const Segments segments{start.data(), end.data(), data_or_null(skip_start), data_or_null(skip_end),
                                    stop_short};
            nb::gil_scoped_release released;
            self.transmittance(segments, count, threads, out.data());
          },
          "start"_a.noconvert(), "end"_a.noconvert(), "skip_start"_a.noconvert().none(),
          "skip_end"_a.noconvert().none(), "stop_short"_a, "out"_a.noconvert(), "threads"_a);
}

}  // namespace rf3dgs
