// Ways: broken lines from the transmitter over mirrors to receivers. src/rf3dgs/field/ways.py is the specification.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace rf3dgs {

constexpr int kMostReflections = 3;

// K sources over P planes, as field.ways.Plan has them; row P of normals and offsets is a plane of no direction, which
// number -1 stands for. axes is null where planes reflect everywhere.
struct WayPlan {
  const double* chain;      // [K, 4, 3] the transmitter and its images [m]
  const int64_t* sequence;  // [K, 3]
  const int64_t* order;     // [K]
  const int64_t* last;      // [K] the plane met last, -1 for none
  const double* side;       // [K] signed distance of the last image from it [m]
  const double* normals;    // [P + 1, 3]
  const double* offsets;    // [P + 1] [m]
  const double* axes;       // [P, 2, 3] in cells
  const double* low;        // [P, 2] in cells
  const double* edge;       // [P, 2] last row and column
  const int64_t* wide;      // [P] columns
  const int64_t* start;     // [P] first cell
  const bool* cells;        // [cell] whether there is surface
  int64_t sources, planes;
};

struct Way {
  int64_t place, source;
  double points[kMostReflections][3], cosine[kMostReflections], distance, arrival[3], departure[3];
};

// The ways to receivers [count, 3] [m], sorted by receiver and source; `asked` [K] may be null for all sources. The bits
// do not depend on `threads`.
std::vector<Way> fold_ways(const WayPlan& plan, const double* receivers, size_t count, const bool* asked, int threads);

}  // namespace rf3dgs
