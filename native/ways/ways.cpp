#include "ways/ways.hpp"

#include <algorithm>
#include <cmath>

#include "core/thread_pool.hpp"

namespace rf3dgs {
namespace {

constexpr size_t kChunk = 64;        // receivers
constexpr double kNearest = 1e-6;    // share of a leg below which an end lies on the plane itself
constexpr double kShortest = 1e-3;   // m: nearer sources count as that far
constexpr double kLeast = 1e-12;     // m: a leg that falls less towards a plane runs along it
constexpr double kUnit = 1e-9;       // m: shorter vectors are not made longer

inline double dot(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// Whether a point lies on the surface of a plane.
bool holds(const WayPlan& plan, int64_t plane, const double* point) {
  int64_t cell[2];
  for (int axis = 0; axis < 2; ++axis) {
    const double local = dot(plan.axes + 6 * plane + 3 * axis, point) - plan.low[2 * plane + axis];
    cell[axis] = static_cast<int64_t>(std::min(std::max(0.0, local), plan.edge[2 * plane + axis]));
  }
  return plan.cells[plan.start[plane] + cell[0] * plan.wide[plane] + cell[1]];
}

// Folds the line from a receiver to the last image of a source back at its planes; false where a plane is missed.
bool folded(const WayPlan& plan, const double* receiver, int64_t source, Way& way) {
  const double* chain = plan.chain + 12 * source;
  double here[3] = {receiver[0], receiver[1], receiver[2]};
  for (int step = kMostReflections - 1; step >= 0; --step) {
    std::copy(receiver, receiver + 3, way.points[step]);
    way.cosine[step] = 1.0;
    if (step >= plan.order[source]) continue;
    const int64_t plane = plan.sequence[3 * source + step];
    const double* normal = plan.normals + 3 * plane;
    double leg[3];
    for (int axis = 0; axis < 3; ++axis) leg[axis] = chain[3 * (step + 1) + axis] - here[axis];
    double fall = dot(leg, normal);
    if (std::abs(fall) < kLeast) fall = kLeast;
    const double share = (plan.offsets[plane] - dot(here, normal)) / fall;
    if (!(share > kNearest && share < 1.0 - kNearest)) return false;
    for (int axis = 0; axis < 3; ++axis) here[axis] += share * leg[axis];
    if (plan.axes != nullptr && !holds(plan, plane, here)) return false;
    std::copy(here, here + 3, way.points[step]);
    way.cosine[step] = std::min(std::abs(fall) / std::max(std::sqrt(dot(leg, leg)), kUnit), 1.0);
  }
  double line[3], out[3];
  for (int axis = 0; axis < 3; ++axis) {
    line[axis] = chain[9 + axis] - receiver[axis];
    out[axis] = here[axis] - plan.chain[axis];
  }
  way.distance = std::max(std::sqrt(dot(line, line)), kShortest);
  const double start = std::max(std::sqrt(dot(out, out)), kUnit);
  for (int axis = 0; axis < 3; ++axis) {
    way.arrival[axis] = line[axis] / way.distance;
    way.departure[axis] = out[axis] / start;
  }
  return true;
}

}  // namespace

std::vector<Way> fold_ways(const WayPlan& plan, const double* receivers, size_t count, const bool* asked, int threads) {
  const size_t chunks = (count + kChunk - 1) / kChunk;
  std::vector<std::vector<Way>> parts(chunks);
  parallel_for(static_cast<int>(chunks), threads, [&](int chunk) {
    std::vector<double> height(plan.planes + 1);
    const size_t begin = chunk * kChunk, end = std::min(count, begin + kChunk);
    for (size_t place = begin; place < end; ++place) {
      const double* receiver = receivers + 3 * place;
      for (int64_t plane = 0; plane <= plan.planes; ++plane)
        height[plane] = dot(receiver, plan.normals + 3 * plane) - plan.offsets[plane];
      for (int64_t source = 0; source < plan.sources; ++source) {
        if (asked != nullptr && !asked[source]) continue;
        const int64_t last = plan.last[source] < 0 ? plan.planes : plan.last[source];
        if (!(height[last] * plan.side[source] < 0.0)) continue;
        Way way;
        if (!folded(plan, receiver, source, way)) continue;
        way.place = static_cast<int64_t>(place);
        way.source = source;
        parts[chunk].push_back(way);
      }
    }
  });
  std::vector<Way> ways;
  size_t total = 0;
  for (const auto& part : parts) total += part.size();
  ways.reserve(total);
  for (const auto& part : parts) ways.insert(ways.end(), part.begin(), part.end());
  return ways;
}

}  // namespace rf3dgs
