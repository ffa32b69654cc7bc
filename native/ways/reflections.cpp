#include "ways/reflections.hpp"

#include <algorithm>
#include <cmath>

#include "core/thread_pool.hpp"
#include "ways/ways.hpp"

namespace rf3dgs {
namespace {

constexpr size_t kChunk = 64;        // ways
constexpr double kMarkPrior = 0.05;  // weight of no deviation
constexpr double kMarkReach = 5.0;   // widths

// What marks near a point of a plane add. Points are at most sqrt 3 times as far apart in x + y + z as they are.
double marked(const ReflectionTable& table, int64_t plane, const double* point) {
  const double farthest = kMarkReach * table.width, window = std::sqrt(3.0) * farthest;
  const double fall = -0.5 / (table.width * table.width), here = point[0] + point[1] + point[2];
  const double* const end = table.along + table.start[plane + 1];
  const double* at = std::lower_bound(table.along + table.start[plane], end, here - window);
  double sum = 0.0, whole = kMarkPrior;
  for (; at < end && *at <= here + window; ++at) {
    const size_t mark = at - table.along;
    const double* place = table.marks + 3 * mark;
    const double x = point[0] - place[0], y = point[1] - place[1], z = point[2] - place[2];
    const double apart2 = x * x + y * y + z * z;
    if (!(apart2 < farthest * farthest)) continue;
    const double weight = std::exp(fall * apart2);
    sum += weight * table.level_db[mark];
    whole += weight;
  }
  return sum / whole;
}

double reflected(const ReflectionTable& table, int64_t plane, double cosine, const double* point) {
  const double* law = table.laws + 3 * plane;
  const double place = cosine * (kRipple - 1);
  const auto below = static_cast<int64_t>(std::min(std::max(0.0, place), kRipple - 2.0));
  const double* ripple = table.ripple + kRipple * plane + below;
  const double smooth = law[0] + cosine * (law[1] + cosine * law[2]);
  const double bent = ripple[0] + (place - static_cast<double>(below)) * (ripple[1] - ripple[0]);
  return std::min(smooth + bent + marked(table, plane, point), 0.0);
}

}  // namespace

void reflect(const ReflectionTable& table, const int64_t* planes, const double* cosine, const double* points,
             size_t count, int threads, double* sum_db) {
  const size_t chunks = (count + kChunk - 1) / kChunk;
  parallel_for(static_cast<int>(chunks), threads, [&](int chunk) {
    const size_t begin = chunk * kChunk, end = std::min(count, begin + kChunk);
    for (size_t way = begin; way < end; ++way) {
      sum_db[way] = 0.0;
      for (size_t at = kMostReflections * way; at < kMostReflections * (way + 1); ++at) {
        if (planes[at] >= 0) sum_db[way] += reflected(table, planes[at], cosine[at], points + 3 * at);
      }
    }
  });
}

}  // namespace rf3dgs
