// The machine's floor, for benchmarks: see core/floor.hpp.
#include "bind_floor.hpp"

#include <stdexcept>
#include <string>

#include "core/floor.hpp"
#include "splats/kernels.hpp"

namespace nb = nanobind;
using namespace nb::literals;
using namespace rf3dgs;

namespace {

const FloorKernels& floor_kernels() {
#if defined(RF3DGS_X86)
  const std::string name = kernels().name;
  if (name == "avx512") return avx512_floor();
  if (name == "avx2") return avx2_floor();
#endif
  return portable_floor();
}

void require_threads(int threads) {
  if (threads < 1 || threads > 1024) throw std::invalid_argument("threads must be 1 to 1024");
}

}  // namespace

void bind_floor(nb::module_& m) {
  m.def(
      "multiply_add_rate",
      [](int threads, double seconds) {
        require_threads(threads);
        nb::gil_scoped_release released;
        return multiply_add_rate(floor_kernels(), threads, seconds);
      },
      "threads"_a, "seconds"_a,
      "Multiply-adds of 16 floats per CPU second of one thread while `threads` do the same, with the instruction set in "
      "use.");
  m.def(
      "bandwidth",
      [](bool change, int threads, size_t bytes, double seconds) {
        require_threads(threads);
        nb::gil_scoped_release released;
        return bandwidth(floor_kernels(), change ? Traffic::change : Traffic::read, threads, bytes, seconds);
      },
      "change"_a, "threads"_a, "bytes"_a, "seconds"_a,
      "Bytes per second that `threads` together read, or read and write, going through `bytes` of memory.");
}
