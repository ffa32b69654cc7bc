// How fast this machine can go at most: what the speed of the splatting core is measured against.
#pragma once

#include <cstddef>

namespace rf3dgs {

// Compiled once for each instruction set. A vector has sixteen floats whatever the registers hold.
struct FloorKernels {
  size_t (*multiply_adds)(size_t rounds, float* sink);  // returns how many vectors it multiplied and added
  void (*read_all)(const float* from, size_t count, float* sink);
  void (*change_all)(float* values, size_t count);
};

const FloorKernels& portable_floor();
#if defined(RF3DGS_X86)
const FloorKernels& avx2_floor();
const FloorKernels& avx512_floor();
#endif

// Multiply-adds of sixteen floats per second of CPU time of one thread while `threads` do the same: the mean over the
// threads of each one's best slice. Takes `seconds`.
double multiply_add_rate(const FloorKernels& kernels, int threads, double seconds);

// Bytes per second that `threads` together move, each going through its share of `bytes`: the sum over the threads of
// each one's best pass, per second of its CPU time. Reading counts every byte once; changing counts it twice, read and
// written. Takes `seconds`.
enum class Traffic { read, change };
double bandwidth(const FloorKernels& kernels, Traffic traffic, int threads, size_t bytes, double seconds);

}  // namespace rf3dgs
