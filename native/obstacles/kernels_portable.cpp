#include "obstacles/kernels_obstacles.hpp"

RF3DGS_DEFINE_OBSTACLES(portable_obstacles)
