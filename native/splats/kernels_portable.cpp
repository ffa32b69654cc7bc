#include "splats/kernels_table.hpp"

RF3DGS_DEFINE_KERNELS(portable_kernels, "portable")
