// The inner loops, compiled once for each instruction set and chosen when the module is loaded.
//
// A kernel sees raw arrays and knows nothing of threads: `rasterize.cpp` cuts the work and owns the memory.
#pragma once

#include <cstddef>
#include <cstdint>

#include "splats/constants.hpp"

namespace rf3dgs {

// A pinhole camera: camera_from_world (row-major rotation, translation), focal lengths and centre in pixels.
struct View {
  float rotation[9];
  float translation[3];
  float fx, fy, cx, cy;
  int width, height;
  float u_low, u_high, v_low, v_high;  // limits of x/z and y/z in the Jacobian
};

// A Gaussian on the screen: centre, inverse covariance (a, b; b, c), opacity, and the value of d^T conic d where its
// alpha falls to the cut.
struct Splat {
  float x, y, a, b, c, opacity, cut;
  uint32_t source;  // index among the caller's Gaussians
};

// What binning needs to know: half the size of the box around a splat [pixel] and its view depth [m].
struct Extent {
  float x, y, depth;
};

// The first and last tiles of a box.
struct TileBox {
  int first_x, first_y, last_x, last_y;
};

// A tile that a splat reaches, with the bits of its 4x4 pixel blocks.
struct Found {
  uint32_t tile, splat, blocks;
};

// A splat in a tile's list with the bits of those 4x4 pixel blocks it reaches.
struct Entry {
  uint32_t splat;
  uint32_t blocks;
};

struct Parameters {
  const float* means;
  const float* quats;
  const float* scales;
  const float* opacities;
  const float* offset;  // added to the projected centres [pixel]; may be null
  const float* values;  // [gaussian, channels]; a Gaussian whose values are not finite is not drawn
  int channels;
};

// Gradients with respect to one splat on the screen.
struct SplatGradient {
  float x, y, a, b, c, opacity;
};

struct GeometryGradients {
  float* means;
  float* quats;
  float* scales;
};

// Floats of an entry's row of gradients.
constexpr int gradient_row(int chunk, bool geometry) { return chunk + (geometry ? 6 : 1); }

// One tile's share of a picture. `values` is [splat, channels] in the order of the splats.
struct Tile {
  int x, y;  // first pixel
  const Entry* entries;
  size_t count;
  const Splat* splats;
  const float* values;
  int channels;       // of values and pictures
  int first, chunk;   // the channels this pass blends
  int width, height;  // of the picture
  const float* background;  // [channels] or null
};

// Two pictures [row, col, channel] to be compared, with an optional weight [row, col].
struct PicturePair {
  const float* a;
  const float* b;
  const float* weight;
  const float* window;  // [kSsimTaps]
  int height, width, channels;
};

// A row's sums of weight * SSIM and weight * |a - b| over columns and channels.
struct LossSums {
  float ssim, l1;
};

// Floats of a row in whole vectors, and of a row with the window's reach on both sides.
constexpr int loss_stride(int width, int channels) { return (width * channels + 15) / 16 * 16; }
constexpr int loss_line(int width, int channels) {
  return loss_stride(width, channels) + 2 * kSsimRadius * channels + 16;
}

struct Kernels {
  const char* name;
  // Projects Gaussians [begin, end); returns how many are visible and appends them to splats/extents.
  size_t (*project)(const View&, const Parameters&, size_t begin, size_t end, Splat*, Extent*, float* radii);
  // From gradients on the screen of splats [begin, end) to gradients of the parameters.
  void (*project_backward)(const View&, const Parameters&, const Splat*, const SplatGradient*, size_t begin, size_t end,
                           const GeometryGradients&);
  // Writes the tiles of a box that a splat reaches, row by row, and returns their number; `out` has room for all.
  size_t (*tiles_reached)(const Splat&, uint32_t index, const TileBox&, int tiles_x, Found* out);
  void (*blend)(const Tile&, float* picture, float* weight);
  // Writes a row of gradients for every entry: of the values of the chunk, of opacity and, when geometry is asked for,
  // of x, y, a, b, c.
  void (*blend_backward)(const Tile&, const float* picture, const float* weight, const float* picture_gradient,
                         const float* weight_gradient, bool geometry, float* rows);
  void (*harmonics)(const float* sh, const float* directions, int bases, int channels, size_t begin, size_t end,
                    float* out);
  void (*harmonics_backward)(const float* gradient, const float* directions, int bases, int channels, size_t begin,
                             size_t end, float* out);
  // Picture similarity, a row at a time; `scratch` holds six lines of `loss_line` floats. First sum weight * SSIM and
  // weight * L1 and write the row's partial derivatives with respect to the blurred a, aa and ab (`loss_stride` floats
  // each); once all rows are there, blur these both ways into the gradient.
  LossSums (*ssim_row)(const PicturePair&, int row, float* const partial[3], float* scratch);
  void (*ssim_gradient_row)(const PicturePair&, int row, const float* const partial[3], float l1_scale,
                            float ssim_scale, float* gradient, float* scratch);
};

const Kernels& portable_kernels();
#if defined(RF3DGS_X86)
const Kernels& avx2_kernels();
const Kernels& avx512_kernels();
#endif

// The widest set this machine can run; RF3DGS_ISA=portable|avx2|avx512 asks for a narrower one.
const Kernels& kernels();

}  // namespace rf3dgs
