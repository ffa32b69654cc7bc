#include "splats/kernels.hpp"

#include <cstdlib>
#include <string>

namespace rf3dgs {
namespace {

const Kernels& choose() {
#if defined(RF3DGS_X86)
  const char* wish = std::getenv("RF3DGS_ISA");
  const std::string wanted = wish == nullptr ? "avx512" : wish;
  __builtin_cpu_init();
  const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  const bool avx512 = avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
                      __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl");
  if (wanted == "avx512" && avx512) return avx512_kernels();
  if (wanted != "portable" && avx2) return avx2_kernels();
#endif
  return portable_kernels();
}

}  // namespace

const Kernels& kernels() {
  static const Kernels& chosen = choose();
  return chosen;
}

}  // namespace rf3dgs
