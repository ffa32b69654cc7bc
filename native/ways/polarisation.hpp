// Polarisation: what ways of several reflections keep of it. src/rf3dgs/field/polarisation.py is the specification.
#pragma once

#include <cstddef>
#include <cstdint>

namespace rf3dgs {

// P planes, as field.polarisation.Slabs has them.
struct SlabTable {
  const double* normals;  // [P, 3]
  const double* slabs;    // [P, 3] relative permittivity and loss, thickness in radians of free space
};

// 10 log10 K [count] of ways at planes [count, 3], -1 for none, at `cosine` [count, 3] of incidence, which leave along
// `departure` [count, 3]. The bits do not depend on `threads`.
void keep(const SlabTable& table, const int64_t* planes, const double* cosine, const double* departure, size_t count,
          int threads, double* kept_db);

}  // namespace rf3dgs
