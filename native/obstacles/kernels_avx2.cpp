#include "obstacles/kernels_obstacles.hpp"

RF3DGS_DEFINE_OBSTACLES(avx2_obstacles)
