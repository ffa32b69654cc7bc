#include "core/kernels_floor.hpp"
#include "splats/kernels_table.hpp"

RF3DGS_DEFINE_KERNELS(avx512_kernels, "avx512")
RF3DGS_DEFINE_FLOOR(avx512_floor)
