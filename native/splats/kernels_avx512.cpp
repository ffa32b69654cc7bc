#include "splats/kernels_table.hpp"

RF3DGS_DEFINE_KERNELS(avx512_kernels, "avx512")
