// What Python sees of the folding of ways: arrays are float64, int64 and bool, C-contiguous, on the CPU and never
// converted.
#include "ways/ways.hpp"

#include <algorithm>
#include <initializer_list>
#include <vector>

#include "bind.hpp"

namespace rf3dgs {
namespace {

using namespace nb::literals;

template <class Number, int... Shape>
using Array = nb::ndarray<const Number, nb::shape<Shape...>, nb::c_contig, nb::device::cpu>;
template <int... Shape>
using Doubles = Array<double, Shape...>;
template <int... Shape>
using Numbers = Array<int64_t, Shape...>;

// The arrays of field.ways.Plan and of its Reach, kept as long as they are asked.
struct HeldPlan {
  Doubles<-1, 4, 3> chain;
  Numbers<-1, 3> sequence;
  Numbers<-1> order, last;
  Doubles<-1> side;
  Doubles<-1, 3> normals;
  Doubles<-1> offsets;
  std::optional<Doubles<-1, 2, 3>> axes;
  std::optional<Doubles<-1, 2>> low, edge;
  std::optional<Numbers<-1>> wide, start;
  std::optional<Array<bool, -1>> cells;

  WayPlan plan() const {
    return {chain.data(), sequence.data(), order.data(), last.data(), side.data(), normals.data(), offsets.data(),
            data_or_null(axes), data_or_null(low), data_or_null(edge), data_or_null(wide), data_or_null(start),
            data_or_null(cells), static_cast<int64_t>(chain.shape(0)), static_cast<int64_t>(offsets.shape(0)) - 1};
  }

  void check() const {
    const size_t sources = chain.shape(0), planes = offsets.shape(0) - 1;
    require(sequence.shape(0) == sources && order.shape(0) == sources && last.shape(0) == sources &&
                side.shape(0) == sources && normals.shape(0) == planes + 1,
            "all arrays need one row per source, and normals one per plane and one more");
    for (size_t source = 0; source < sources; ++source) {
      const int64_t steps = order.data()[source];
      require(steps >= 0 && steps <= kMostReflections && last.data()[source] < static_cast<int64_t>(planes),
              "a source has up to three reflections, in planes that there are");
      for (int64_t step = 0; step < steps; ++step) {
        const int64_t plane = sequence.data()[3 * source + step];
        require(plane >= 0 && plane < static_cast<int64_t>(planes),
                "a source has up to three reflections, in planes that there are");
      }
    }
    if (!axes) return;
    require(low && edge && wide && start && cells && axes->shape(0) == planes && low->shape(0) == planes &&
                edge->shape(0) == planes && wide->shape(0) == planes && start->shape(0) == planes,
            "where planes have surface needs one row per plane");
    for (size_t plane = 0; plane < planes; ++plane) {
      const double rows = edge->data()[2 * plane], columns = edge->data()[2 * plane + 1];
      const int64_t first = start->data()[plane], across = wide->data()[plane];
      require(rows >= 0.0 && rows < 1e9 && columns >= 0.0 && columns < 1e9 && first >= 0 && across > 0 &&
                  across < (1 << 30) &&
                  first + static_cast<int64_t>(rows) * across + static_cast<int64_t>(columns) <
                      static_cast<int64_t>(cells->shape(0)),
              "the cells of a plane lie beyond the last");
    }
  }
};

template <class Number, class Read>
nb::ndarray<nb::numpy, Number> column(const std::vector<Way>& ways, std::initializer_list<size_t> row, Read read) {
  size_t width = 1;
  std::vector<size_t> shape{ways.size()};
  for (size_t size : row) {
    width *= size;
    shape.push_back(size);
  }
  auto* values = new Number[ways.size() * width + 1];
  nb::capsule owner(values, [](void* old) noexcept { delete[] static_cast<Number*>(old); });
  for (size_t at = 0; at < ways.size(); ++at) {
    const Number* first = read(ways[at]);
    std::copy(first, first + width, values + at * width);
  }
  return nb::ndarray<nb::numpy, Number>(values, shape.size(), shape.data(), owner);
}

nb::tuple fold(const HeldPlan& held, Doubles<-1, 3> receivers, std::optional<Array<bool, -1>> asked, int threads) {
  require(!asked || asked->shape(0) == held.chain.shape(0), "asked needs one value per source");
  std::vector<Way> ways;
  {
    const WayPlan plan = held.plan();
    const double* places = receivers.data();
    const bool* wanted = data_or_null(asked);
    const size_t count = receivers.shape(0);
    nb::gil_scoped_release released;
    ways = fold_ways(plan, places, count, wanted, threads);
  }
  return nb::make_tuple(column<int64_t>(ways, {}, [](const Way& way) { return &way.place; }),
                        column<int64_t>(ways, {}, [](const Way& way) { return &way.source; }),
                        column<double>(ways, {kMostReflections, 3}, [](const Way& way) { return &way.points[0][0]; }),
                        column<double>(ways, {kMostReflections}, [](const Way& way) { return &way.cosine[0]; }),
                        column<double>(ways, {}, [](const Way& way) { return &way.distance; }),
                        column<double>(ways, {3}, [](const Way& way) { return &way.arrival[0]; }),
                        column<double>(ways, {3}, [](const Way& way) { return &way.departure[0]; }));
}

}  // namespace

void bind_ways(nb::module_& m) {
  nb::class_<HeldPlan>(m, "WayPlan", "Sources and planes, asked for the ways to receivers.")
      .def(
          "__init__",
          [](HeldPlan* self, Doubles<-1, 4, 3> chain, Numbers<-1, 3> sequence, Numbers<-1> order, Numbers<-1> last,
             Doubles<-1> side, Doubles<-1, 3> normals, Doubles<-1> offsets, std::optional<Doubles<-1, 2, 3>> axes,
             std::optional<Doubles<-1, 2>> low, std::optional<Doubles<-1, 2>> edge, std::optional<Numbers<-1>> wide,
             std::optional<Numbers<-1>> start, std::optional<Array<bool, -1>> cells) {
            require(offsets.shape(0) > 0, "there is a plane of no direction behind the others");
            HeldPlan made{chain, sequence, order, last, side, normals, offsets, axes, low, edge, wide, start, cells};
            made.check();
            new (self) HeldPlan(std::move(made));
          },
          "chain"_a.noconvert(), "sequence"_a.noconvert(), "order"_a.noconvert(), "last"_a.noconvert(),
          "side"_a.noconvert(), "normals"_a.noconvert(), "offsets"_a.noconvert(), "axes"_a.noconvert().none(),
          "low"_a.noconvert().none(), "edge"_a.noconvert().none(), "wide"_a.noconvert().none(),
          "start"_a.noconvert().none(), "cells"_a.noconvert().none())
      .def("fold", &fold, "receivers"_a.noconvert(), "asked"_a.noconvert().none(), "threads"_a);
}

}  // namespace rf3dgs
