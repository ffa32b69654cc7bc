#include "core/kernels_floor.hpp"
#include "splats/kernels_table.hpp"

RF3DGS_DEFINE_KERNELS(avx2_kernels, "avx2")
RF3DGS_DEFINE_FLOOR(avx2_floor)
