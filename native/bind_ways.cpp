// What Python sees of the folding of ways, of their reflections and of their polarisation: arrays are float64, int64 and
// bool, C-contiguous, on the CPU and never converted.
#include "ways/ways.hpp"

#include <algorithm>
#include <cmath>
#include <initializer_list>
#include <vector>

#include "bind.hpp"
#include "ways/polarisation.hpp"
#include "ways/reflections.hpp"

namespace rf3dgs {
namespace {

using namespace nb::literals;

template <class Number, int... Shape>
using Array = nb::ndarray<const Number, nb::shape<Shape...>, nb::c_contig, nb::device::cpu>;
template <int... Shape>
using Doubles = Array<double, Shape...>;
template <int... Shape>
using Numbers = Array<int64_t, Shape...>;
using Result = nb::ndarray<double, nb::shape<-1>, nb::c_contig, nb::device::cpu>;

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

// The arrays of field.reflections.Reflections, kept as long as they are asked.
struct HeldReflections {
  Doubles<-1, 3> laws;
  Doubles<-1, kRipple> ripple;
  Doubles<-1, 3> marks;
  Doubles<-1> along, level_db;
  Numbers<-1> start;
  double width;

  int64_t planes() const { return static_cast<int64_t>(laws.shape(0)); }

  ReflectionTable table() const {
    return {laws.data(), ripple.data(), marks.data(), along.data(), level_db.data(), start.data(), width};
  }

  void check() const {
    const size_t count = marks.shape(0);
    require(ripple.shape(0) == laws.shape(0) && start.shape(0) == laws.shape(0) + 1,
            "laws and ripple need one row per plane, and start one more");
    require(along.shape(0) == count && level_db.shape(0) == count, "marks need one row per mark");
    const int64_t* first = start.data();
    require(first[0] == 0 && first[planes()] == static_cast<int64_t>(count) &&
                std::is_sorted(first, first + planes() + 1),
            "marks are sorted by plane, from the first to the last");
    require(width > 0.0 && std::isfinite(width), "the width of marks is a length");
  }
};

void sum_of(const HeldReflections& held, Numbers<-1, kMostReflections> planes, Doubles<-1, kMostReflections> cosine,
            Doubles<-1, kMostReflections, 3> points, Result sum_db, int threads) {
  const size_t count = planes.shape(0);
  require(cosine.shape(0) == count && points.shape(0) == count && sum_db.shape(0) == count,
          "all arrays need one row per way");
  const int64_t* plane = planes.data();
  require(std::all_of(plane, plane + kMostReflections * count,
                      [&](int64_t each) { return each >= -1 && each < held.planes(); }),
          "a way is reflected at planes that there are");
  const ReflectionTable table = held.table();
  nb::gil_scoped_release released;
  reflect(table, plane, cosine.data(), points.data(), count, threads, sum_db.data());
}

// The arrays of field.polarisation.Slabs, kept as long as they are asked.
struct HeldSlabs {
  Doubles<-1, 3> normals, slabs;

  int64_t planes() const { return static_cast<int64_t>(normals.shape(0)); }
};

void kept_of(const HeldSlabs& held, Numbers<-1, kMostReflections> planes, Doubles<-1, kMostReflections> cosine,
             Doubles<-1, 3> departure, Result kept_db, int threads) {
  const size_t count = planes.shape(0);
  require(cosine.shape(0) == count && departure.shape(0) == count && kept_db.shape(0) == count,
          "all arrays need one row per way");
  const int64_t* plane = planes.data();
  require(std::all_of(plane, plane + kMostReflections * count,
                      [&](int64_t each) { return each >= -1 && each < held.planes(); }),
          "a way is reflected at planes that there are");
  const SlabTable table{held.normals.data(), held.slabs.data()};
  nb::gil_scoped_release released;
  keep(table, plane, cosine.data(), departure.data(), count, threads, kept_db.data());
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
  nb::class_<HeldReflections>(m, "Reflections", "What planes take from the power of ways.")
      .def(
          "__init__",
          [](HeldReflections* self, Doubles<-1, 3> laws, Doubles<-1, kRipple> ripple, Doubles<-1, 3> marks,
             Doubles<-1> along, Doubles<-1> level_db, Numbers<-1> start, double width) {
            HeldReflections made{laws, ripple, marks, along, level_db, start, width};
            made.check();
            new (self) HeldReflections(std::move(made));
          },
          "laws"_a.noconvert(), "ripple"_a.noconvert(), "marks"_a.noconvert(), "along"_a.noconvert(),
          "level_db"_a.noconvert(), "start"_a.noconvert(), "width"_a)
      .def("sum_db", &sum_of, "planes"_a.noconvert(), "cosine"_a.noconvert(), "points"_a.noconvert(),
           "out"_a.noconvert(), "threads"_a);
  nb::class_<HeldSlabs>(m, "Slabs", "What planes do to the polarisation of ways.")
      .def(
          "__init__",
          [](HeldSlabs* self, Doubles<-1, 3> normals, Doubles<-1, 3> slabs) {
            require(slabs.shape(0) == normals.shape(0), "normals and slabs need one row per plane");
            new (self) HeldSlabs{normals, slabs};
          },
          "normals"_a.noconvert(), "slabs"_a.noconvert())
      .def("kept_db", &kept_of, "planes"_a.noconvert(), "cosine"_a.noconvert(), "departure"_a.noconvert(),
           "out"_a.noconvert(), "threads"_a);
}

}  // namespace rf3dgs
