// What Python sees of the sums over paths: arrays are C-contiguous, on the CPU and never converted.
#include "bind_spectra.hpp"

#include <cmath>

#include "bind.hpp"
#include "spectra/deposit.hpp"
#include "spectra/responses.hpp"

using namespace rf3dgs;
using namespace nb::literals;

namespace {

template <int... Shape>
using In64 = nb::ndarray<const double, nb::shape<Shape...>, nb::c_contig, nb::device::cpu>;
template <int... Shape>
using Out64 = nb::ndarray<double, nb::shape<Shape...>, nb::c_contig, nb::device::cpu>;

constexpr size_t kMostPaths = size_t{1} << 31;

void spread(In64<-1, 2> coeff, In64<-1> place, In64<-1, 3> directions, In64<kSpreadTerms, kSpreadColumns> polynomials,
            double column_phase, double row_phase, int rows, int cols, Out64<-1, -1> total, int threads) {
  const size_t count = coeff.shape(0);
  require(place.shape(0) == count && directions.shape(0) == count && count < kMostPaths,
          "all arrays need one row per path");
  require(rows > 0 && cols > 0 && rows <= 4096 && cols <= 4096, "an array has 1 to 4096 rows and columns");
  require(total.shape(0) == 2 * static_cast<size_t>(rows) * cols && total.shape(1) > 0 && total.shape(1) < kMostPaths,
          "total must have two lines for each element and at least one cell");
  const PathWaves waves{coeff.data(), place.data(), directions.data(), polynomials.data(),
                        column_phase, row_phase, rows, cols};
  nb::gil_scoped_release released;
  spread_responses(waves, count, static_cast<int>(total.shape(1)), total.data(), threads);
}

void deposit(In<-1, 3> directions, In<-1> gain, In<-1> delay, In<-1, 3> departures, int fold,
             Out64<kDepositChannels, -1, -1> total, int threads) {
  const size_t count = gain.shape(0);
  require(directions.shape(0) == count && delay.shape(0) == count && departures.shape(0) == count && count < kMostPaths,
          "all arrays need one row per path");
  require(total.shape(1) > 0 && total.shape(2) > 0 && total.shape(1) < 65536 && total.shape(2) < 65536 && fold >= 0 &&
              fold <= 65536,
          "the sphere has 1 to 65535 rows and columns");
  nb::gil_scoped_release released;
  deposit_paths({directions.data(), gain.data(), delay.data(), departures.data()}, count,
                static_cast<int>(total.shape(1)), static_cast<int>(total.shape(2)), fold, total.data(), threads);
}

}  // namespace

void bind_spectra(nb::module_& m) {
  m.def("spread_responses", &spread, "coeff"_a.noconvert(), "place"_a.noconvert(), "directions"_a.noconvert(),
        "polynomials"_a.noconvert(), "column_phase"_a, "row_phase"_a, "rows"_a, "cols"_a, "total"_a.noconvert(),
        "threads"_a);
  m.def("deposit_paths", &deposit, "directions"_a.noconvert(), "gain"_a.noconvert(), "delay"_a.noconvert(),
        "departures"_a.noconvert(), "fold"_a, "total"_a.noconvert(), "threads"_a);
}
