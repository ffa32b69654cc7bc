#include "splats/kernels_table.hpp"

RF3DGS_DEFINE_KERNELS(avx2_kernels, "avx2")
