#include "ways/polarisation.hpp"

#include <algorithm>
#include <cmath>
#include <complex>

#include "core/thread_pool.hpp"
#include "ways/ways.hpp"

namespace rf3dgs {
namespace {

using Complex = std::complex<double>;

constexpr size_t kChunk = 64;          // ways
constexpr double kGrazing = 1e-3;      // cosine
constexpr double kHeadOn = 1e-6;       // sine below which the plane of incidence is any
constexpr double kLeastKept = 1e-6;

struct Vector {
  double x, y, z;
};

inline double dot(Vector a, Vector b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vector cross(Vector a, Vector b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
inline Vector scaled(Vector a, double by) { return {a.x * by, a.y * by, a.z * by}; }
inline Vector vector_at(const double* from) { return {from[0], from[1], from[2]}; }

// The unit vector across the plane of incidence of a wave along `way`.
Vector across(Vector way, Vector normal) {
  Vector te = cross(way, normal);
  double size = std::sqrt(dot(te, te));
  if (!(size > kHeadOn)) {
    te = cross(way, std::abs(way.x) < 0.9 ? Vector{1.0, 0.0, 0.0} : Vector{0.0, 1.0, 0.0});
    size = std::sqrt(dot(te, te));
  }
  return scaled(te, 1.0 / std::max(size, kHeadOn));
}

// What a slab reflects of TE and TM, over the root of the mean of both powers.
void coefficients(const double* slab, double cosine, Complex& te, Complex& tm) {
  const Complex eta{slab[0], -slab[1]};
  const double cos = std::max(cosine, kGrazing);
  const Complex root = std::sqrt(eta - (1.0 - cos * cos));
  te = (cos - root) / (cos + root);
  tm = (eta * cos - root) / (eta * cos + root);
  if (!std::isinf(slab[2])) {
    const Complex turn = std::exp(Complex{0.0, -2.0} * slab[2] * root);
    te *= (1.0 - turn) / (1.0 - te * te * turn);
    tm *= (1.0 - turn) / (1.0 - tm * tm * turn);
  }
  const double size = std::sqrt(0.5 * (std::norm(te) + std::norm(tm)));
  te = size > 0.0 ? te / size : Complex{-1.0};
  tm = size > 0.0 ? tm / size : Complex{1.0};
}

double kept(const SlabTable& table, const int64_t* planes, const double* cosine, Vector way) {
  Complex jones[2][2] = {{1.0, 0.0}, {0.0, 1.0}};
  Vector te_before{}, tm_before{};
  for (int step = 0; step < kMostReflections && planes[step] >= 0; ++step) {
    const Vector normal = vector_at(table.normals + 3 * planes[step]);
    const Vector te = across(way, normal), tm = cross(te, way);
    if (step > 0) {
      const double turn[2][2] = {{dot(te, te_before), dot(te, tm_before)}, {dot(tm, te_before), dot(tm, tm_before)}};
      for (int column = 0; column < 2; ++column) {
        const Complex first = jones[0][column], second = jones[1][column];
        jones[0][column] = turn[0][0] * first + turn[0][1] * second;
        jones[1][column] = turn[1][0] * first + turn[1][1] * second;
      }
    }
    Complex of_te, of_tm;
    coefficients(table.slabs + 3 * planes[step], cosine[step], of_te, of_tm);
    for (int column = 0; column < 2; ++column) {
      jones[0][column] *= of_te;
      jones[1][column] *= of_tm;
    }
    const double fall = 2.0 * dot(way, normal);
    way = {way.x - fall * normal.x, way.y - fall * normal.y, way.z - fall * normal.z};
    te_before = te;
    tm_before = cross(te, way);
  }
  double power = 0.0;
  for (const auto& row : jones) power += 0.5 * (std::norm(row[0]) + std::norm(row[1]));
  return 10.0 * std::log10(std::max(power, kLeastKept));
}

}  // namespace

void keep(const SlabTable& table, const int64_t* planes, const double* cosine, const double* departure, size_t count,
          int threads, double* kept_db) {
  const size_t chunks = (count + kChunk - 1) / kChunk;
  parallel_for(static_cast<int>(chunks), threads, [&](int chunk) {
    const size_t begin = chunk * kChunk, end = std::min(count, begin + kChunk);
    for (size_t way = begin; way < end; ++way) {
      const size_t at = kMostReflections * way;
      kept_db[way] = planes[at + 1] < 0 ? 0.0 : kept(table, planes + at, cosine + at, vector_at(departure + 3 * way));
    }
  });
}

}  // namespace rf3dgs
