#include "core/kernels_floor.hpp"
#include "splats/kernels_table.hpp"

RF3DGS_DEFINE_KERNELS(portable_kernels, "portable")
RF3DGS_DEFINE_FLOOR(portable_floor)
