// The inner loops, compiled once for each instruction set and chosen when the module is loaded.
//
// A kernel sees raw arrays and knows nothing of threads: `rasterize.cpp` cuts the work and owns the memory.
#pragma once

#include <cstddef>
#include <cstdint>

#include "splats/constants.hpp"
#include "splats/training_kernels.hpp"

namespace rf3dgs {

enum class Kind { pinhole, sphere };
constexpr int kKinds = 2;
constexpr int kMostGeometrySums = 9;  // of any shape

// Sines and cosines, 16 and 16, of the azimuths of columns on the sphere, counted from the left edge, and of the zenith
// angles of rows: of a 4x4 block's pixels for each column and each row of blocks, and of the middles of a tile's blocks for
// each column and each row of tiles.
struct SphereGrid {
  const float* block_column;
  const float* block_row;
  const float* tile_column;
  const float* tile_row;
};

// camera_from_world (row-major rotation, translation) and the picture's size; for a pinhole also focal lengths and
// centre in pixels and the limits of x/z and y/z in the Jacobian; for the sphere its tables, which `rasterize` fills in.
struct View {
  Kind kind;
  float rotation[9];
  float translation[3];
  int width, height;
  float fx, fy, cx, cy;
  float u_low, u_high, v_low, v_high;
  float blur = kBlur;  // added to both variances of a projected Gaussian [pixel^2]
  SphereGrid sphere;
};

// Activated Gaussians, as the caller keeps them.
struct Geometry {
  const float* means;
  const float* quats;
  const float* scales;
  const float* opacities;
  const float* offset;  // [gaussian, 2] added to the projected centres [pixel]; may be null
  const float* bounds = nullptr;  // of groups, see below; or null
};

// Where sixteen neighbours are: five columns [bound_groups] of the x, y, z and radius of a ball around their means and
// of their largest scale [m]. Made once while the geometry rests, they tell which Gaussians a view cannot show before
// these are read.
constexpr int kBoundGroup = 16, kBoundColumns = 5;
constexpr size_t bound_groups(size_t gaussians) { return (gaussians + 255) / 256 * 16; }

// The pixels a splat may reach: from left to right and top to bottom; none where right < left. On the sphere columns
// count round and round.
struct Extent {
  float left, top, right, bottom;
};
constexpr Extent kNowhere = {1.0f, 1.0f, -1.0f, -1.0f};

// Where a projection puts the visible ones of its Gaussians, one after the other. `radii` has a place for every Gaussian.
struct Projected {
  float* splats;  // of the view's kind
  uint32_t* sources;
  Extent* extents;
  float* radii;
};

// A tile that a splat reaches, with the bits of its 4x4 pixel blocks.
struct Found {
  uint32_t tile, blocks, splat;
  float depth;
};

// A splat in a tile's list. Entries are numbered (`slot`) splat by splat, and within a splat tile by tile, which is where
// their gradients go.
struct Entry {
  uint32_t splat, slot, blocks;
};

// Rows of gradients of visible splats: of the activated parameters for a pinhole; on the sphere of what the splat is
// drawn with (see `project_sphere_backward`).
struct GeometryRows {
  float* means;
  float* quats;
  float* scales;
  float* offset;
  float* sphere;  // [., 9]
};

// One tile's share of a picture. Splats and values [splat, channels] are in the order of the Gaussians.
struct Tile {
  const View* view;
  int x, y;  // first pixel
  const Entry* entries;
  size_t count;
  const float* splats;  // of the view's kind
  const float* values;
  int channels;      // of values and pictures
  int first, chunk;  // the channels this pass blends
  float gate;        // how far behind the depth of half transmittance Gaussians count [m]; may be infinite
};

// What forward blending writes: pictures, and the largest weight of each slot where it is asked for.
struct Blended {
  float* picture;
  float* weight;
  const float* background;  // [channels] or null
  float* peaks;             // [slot] or null
};

// What backward blending reads, and the rows [slot, gradient_row] it writes.
struct Slopes {
  const float* picture;
  const float* weight;
  const float* picture_gradient;
  const float* weight_gradient;  // or null
  bool geometry;
  float* rows;
};

// Floats of an entry's row of gradients: of a chunk of values, of ln alpha, and geometry sums, rounded up to whole fours.
constexpr int gradient_row(int chunk, int geometry_sums) { return (chunk + 1 + geometry_sums + 3) / 4 * 4; }

// What depends on the kind of view. A shape (kernels_pinhole.hpp, kernels_sphere.hpp) supplies these.
struct ShapeKernels {
  int splat_floats;   // size of a splat
  int geometry_sums;  // that backward blending adds up for a splat
  // Projects Gaussians [begin, end) of all and returns how many are visible; begin is a multiple of 256.
  size_t (*project)(const View&, const Geometry&, size_t gaussians, size_t begin, size_t end, const Projected&);
  // From the geometry sums [count, geometry_sums] of splats to rows of gradients.
  void (*project_backward)(const View&, const Geometry&, const uint32_t* sources, const float* sums, size_t count,
                           const GeometryRows&);
  // Writes the tiles that up to kReachGroup splats reach, splat by splat and row by row, and returns their number; `out`
  // has room for all tiles of each and three more. `number` is what the first of them is called, `reached` receives each one's tiles.
  size_t (*tiles_reached)(const View&, const float* splats, const Extent*, int count, uint32_t number, uint32_t* reached,
                          Found* out);
  void (*blend)(const Tile&, const Blended&);
  // A row of gradients for every entry: of the values of the chunk, the sum of d loss / d ln alpha and, when asked for,
  // the geometry sums.
  void (*blend_backward)(const Tile&, const Slopes&);
};

constexpr int kReachGroup = 16;

// Two pictures [row, col, channel] to be compared, with an optional weight [row, col]. The blurred b and bb [row,
// loss_stride] may be known; they are not used in rows that see a pixel in which b was changed.
struct PicturePair {
  const float* a;
  const float* b;
  const float* weight;
  const float* window;  // [kSsimTaps]
  const float* mean;
  const float* square;
  const uint8_t* is_composed;  // [row]
  int height, width, channels;
};

// A row's sums of weight * SSIM and weight * |a - b| over columns and channels.
struct LossSums {
  float ssim, l1;
};

// Floats of a row in whole vectors.
constexpr int loss_stride(int width, int channels) { return (width * channels + 15) / 16 * 16; }
// The loss takes this many rows at a time. Its scratch memory holds so many lines of five maps, each padded by the
// window's reach in whole vectors, and two lines more.
constexpr int kLossRows = 8;
constexpr int kLossMaps = 5;
constexpr int loss_pad(int channels) { return (kSsimRadius * channels + 15) / 16 * 16; }
constexpr size_t loss_scratch(int width, int channels) {
  const size_t line = loss_stride(width, channels) + 2 * loss_pad(channels);
  return (kLossMaps * kLossRows + 2) * line;
}

struct Kernels {
  const char* name;
  ShapeKernels shape[kKinds];
  // The bounds of groups [begin, end); all [kBoundColumns, bound_groups] have to be written.
  void (*bound)(const float* means, const float* scales, size_t gaussians, size_t begin, size_t end, float* bounds);
  void (*harmonics)(const float* sh, const float* directions, int bases, int channels, size_t begin, size_t end,
                    float* out);
  void (*harmonics_backward)(const float* gradient, const float* directions, int bases, int channels, size_t begin,
                             size_t end, float* out);
  // Picture similarity, up to `kLossRows` rows from `first` on; `scratch` holds `loss_scratch` floats and is aligned to
  // vectors. First the sums of each row and the partial derivatives with respect to the blurred a, aa and ab (planes
  // [row, loss_stride]); once all rows are there, these are blurred both ways into the gradient.
  void (*ssim_rows)(const PicturePair&, int first, int rows, float* const partial[3], LossSums* sums, float* scratch);
  void (*ssim_gradient_rows)(const PicturePair&, int first, int rows, const float* const partial[3], float l1_scale,
                             float ssim_scale, float* gradient, float* scratch);
  // The same two without similarity.
  void (*l1_rows)(const PicturePair&, int first, int rows, float* const partial[3], LossSums* sums, float* scratch);
  void (*l1_gradient_rows)(const PicturePair&, int first, int rows, const float* const partial[3], float l1_scale,
                           float ssim_scale, float* gradient, float* scratch);
  // The blurred b and bb of rows.
  void (*target_rows)(const PicturePair&, int first, int rows, float* mean, float* square, float* scratch);
  TrainingKernels training;
};

const Kernels& portable_kernels();
#if defined(RF3DGS_X86)
const Kernels& avx2_kernels();
const Kernels& avx512_kernels();
#endif

// The widest set this machine can run; RF3DGS_ISA=portable|avx2|avx512 asks for a narrower one.
const Kernels& kernels();

}  // namespace rf3dgs
