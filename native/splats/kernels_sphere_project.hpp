// Projection of Gaussians to the sphere and the first half of its derivative, sixteen Gaussians at a time.
//
//   p = W mu + t,  r = |p|,  m = p / r,  E = [east; north] at m,  A = E W R S / r,  Sigma2 = A A^T + blur,
//   for a pixel's direction d:  (f1, f2) = E^T root,  u = (d.f1, d.f2) / (d.m),  log2 alpha = peak - |u|^2.
//
// In the camera frame (x right, y down, z forward), d = (-S sin t, -C, -S cos t) where t runs with the columns, S and C
// are sine and cosine of the zenith angle that runs with the rows.
#pragma once

#include "core/rows.hpp"
#include "core/vector.hpp"
#include "splats/constants.hpp"
#include "splats/kernels.hpp"
#include "splats/kernels_project.hpp"

namespace {

using namespace rf3dgs;

constexpr float kPi = 3.14159265358979f;
constexpr float kWidestTangent = 4.9f;  // of the angle whose cosine is kSphereField

// A Gaussian on the sphere. `reach` is the square of |u| at the cut, widened by what the block test neglects; infinite
// where that test cannot be trusted.
struct SphereSplat {
  float f1[3], f2[3], m[3], peak, depth, reach;
};

struct SphereProjection {
  Projection p;
  Vec range, mx, my, mz;
  Vec hx, hz, sine, cosine;  // horizontal direction and zenith angle of m
  Vec sxx, sxy, syy, inverse_determinant;
};

RF_INLINE Vec abs_vec(Vec value) { return max_vec(value, -value); }

// atan2 with an error below 1e-6. Abramowitz and Stegun 4.4.49.
RF_INLINE Vec atan2_vec(Vec y, Vec x) {
  const Vec ax = abs_vec(x), ay = abs_vec(y), larger = max_vec(max_vec(ax, ay), splat_vec(1e-30f));
  const Vec r = min_vec(ax, ay) / larger, rr = r * r;
  Vec sum = splat_vec(0.0028662257f);
  sum = sum * rr - 0.0161657367f;
  sum = sum * rr + 0.0429096138f;
  sum = sum * rr - 0.0752896400f;
  sum = sum * rr + 0.1065626393f;
  sum = sum * rr - 0.1420889944f;
  sum = sum * rr + 0.1999355085f;
  sum = sum * rr - 0.3333314528f;
  Vec angle = r + r * rr * sum;
  angle = select(ay > ax, 0.5f * kPi - angle, angle);
  angle = select(x < 0.0f, kPi - angle, angle);
  return select(y < 0.0f, -angle, angle);
}

RF_INLINE float pixel_area(const View& view) { return (2 * kPi / view.width) * (kPi / view.height); }

template <class Which>
RF_INLINE void project_sphere_lanes(const View& view, const Geometry& in, const Which& which, SphereProjection& s) {
  Projection& p = s.p;
  place_lanes(view, in, which, p);
  turn_lanes(in, which, p);
  const Vec squared = p.x * p.x + p.y * p.y + p.z * p.z;
  s.range = sqrt_vec(squared);
  p.fine &= (s.range > kNear) & is_finite(squared);
  const Vec inverse = 1.0f / s.range;
  s.mx = p.x * inverse;
  s.my = p.y * inverse;
  s.mz = p.z * inverse;
  s.cosine = -s.my;
  s.sine = sqrt_vec(s.mx * s.mx + s.mz * s.mz);
  const IntVec upright = s.sine > 1e-12f;  // at the poles any direction will do
  const Vec level = 1.0f / max_vec(s.sine, splat_vec(1e-12f));
  s.hx = select(upright, s.mx * level, Vec{});
  s.hz = select(upright, s.mz * level, splat_vec(1.0f));
  const float* w = view.rotation;
  for (int col = 0; col < 3; ++col) {
    p.t[col] = (s.hz * w[col] - s.hx * w[6 + col]) * inverse;
    p.t[3 + col] = -(s.cosine * (s.hx * w[col] + s.hz * w[6 + col]) + s.sine * w[3 + col]) * inverse;
  }
  for (int row = 0; row < 2; ++row) {
    for (int col = 0; col < 3; ++col) {
      const Vec* t = p.t + 3 * row;
      p.a[3 * row + col] = (t[0] * p.r[col] + t[1] * p.r[3 + col] + t[2] * p.r[6 + col]) * p.s[col];
    }
  }
  const float blur = view.blur * pixel_area(view);
  const Vec* a = p.a;
  const Vec first = a[0] * a[0] + a[1] * a[1] + a[2] * a[2];
  const Vec second = a[3] * a[3] + a[4] * a[4] + a[5] * a[5];
  const Vec c0 = a[1] * a[5] - a[2] * a[4], c1 = a[2] * a[3] - a[0] * a[5], c2 = a[0] * a[4] - a[1] * a[3];
  const Vec determinant = blur * blur + blur * (first + second) + (c0 * c0 + c1 * c1 + c2 * c2);
  s.sxx = first + blur;
  s.syy = second + blur;
  s.sxy = a[0] * a[3] + a[1] * a[4] + a[2] * a[5];
  p.fine &= is_finite(determinant);
  s.inverse_determinant = 1.0f / determinant;
}

// The rows and columns that the cut's cone around m may touch. Its extreme zenith angles are those of the ellipse's box in
// the tangent plane, either on m's meridian or in the box's corners; its extreme azimuths are where a vertical plane
// touches the ellipse: t^2 (S^2 - R^2 C^2 syy) - 2 t C R^2 sxy - R^2 sxx = 0 for t the tangent of the azimuth's change.
RF_INLINE void extent_of(const View& view, const SphereProjection& s, Vec reach, Vec edges[4]) {
  const Vec x = min_vec(reach * sqrt_vec(s.sxx), splat_vec(kWidestTangent));
  const Vec y = min_vec(reach * sqrt_vec(s.syy), splat_vec(kWidestTangent));
  const Vec zenith = atan2_vec(s.sine, s.cosine), along = atan2_vec(y, splat_vec(1.0f));
  const Vec upper = s.sine - y * s.cosine, lower = s.sine + y * s.cosine;
  const Vec upper_corner = atan2_vec(sqrt_vec(upper * upper + x * x), s.cosine + y * s.sine);
  const Vec lower_corner = atan2_vec(sqrt_vec(lower * lower + x * x), s.cosine - y * s.sine);
  const Vec top = min_vec(zenith - along, min_vec(upper_corner, lower_corner));
  const Vec bottom = max_vec(zenith + along, max_vec(upper_corner, lower_corner));
  const float rows = view.height / kPi, columns = view.width / (2 * kPi);
  edges[1] = rows * top;
  edges[3] = rows * bottom;
  const Vec squared = reach * reach, b = squared * s.cosine * s.sxy;
  const Vec a = s.sine * s.sine - 1.001f * squared * s.cosine * s.cosine * s.syy;
  const Vec root = sqrt_vec(max_vec(b * b + a * squared * s.sxx, Vec{}));
  const IntVec holds_pole = a <= 1e-5f;
  const Vec half = splat_vec(kPi);
  const Vec turn = atan2_vec(-s.hx, -s.hz);
  edges[0] = columns * (turn + select(holds_pole, -half, atan2_vec(b - root, a)));
  edges[2] = columns * (turn + select(holds_pole, half, atan2_vec(b + root, a)));
}

// The square of |u| that a block's test allows: the cut's, widened by how far a pixel of a block may lie, in standard
// deviations, from where the block's middle and slopes put it. The tangent plane's coordinates bend by half their second
// derivatives: the sphere's own, which vanish on the equator, and the plane's, which grow with the tangent.
RF_INLINE Vec block_reach(const View& view, const SphereProjection& s, Vec above_cut, Vec major) {
  const float turn = 1.5f * 2 * kPi / view.width, tilt = 1.5f * kPi / view.height;
  const float squared = turn * turn + tilt * tilt, step = __builtin_sqrtf(squared);
  const Vec tangent = sqrt_vec(above_cut * (1.0f / kHalfLog2E) * major) + step;
  const Vec tilted = min_vec(abs_vec(s.cosine) + tangent, splat_vec(1.0f));
  const Vec bend = (turn * tilt + 0.5f * turn * turn) * tilted + squared * tangent * (1.0f + tangent * tangent) +
                   squared * step;
  const Vec reach = sqrt_vec(above_cut) + 1e-3f + bend * sqrt_vec(kHalfLog2E * major * s.inverse_determinant);
  const IntVec trusted = tangent < (step < 0.2f ? 1.5f : -1.0f);
  return select(trusted, reach * reach, splat_vec(__builtin_inff()));
}

size_t project_sphere(const View& view, const Geometry& in, size_t, size_t begin, size_t end, const Projected& out) {
  const float per_pixel = 1.0f / __builtin_sqrtf(pixel_area(view));
  size_t visible = 0;
  std::memset(out.radii + begin, 0, (end - begin) * sizeof(float));
  for (size_t start = begin; start < end; start += kLanes) {
    const int lanes = static_cast<int>(end - start < kLanes ? end - start : kLanes);
    const Neighbours which = {start, lanes};
    SphereProjection s;
    project_sphere_lanes(view, in, which, s);
    const Vec opacity = load_some(in.opacities + start, lanes);
    IntVec fine = s.p.fine & (opacity >= kAlphaMin) & is_finite(opacity);
    const Vec middle = 0.5f * (s.sxx + s.syy), half = 0.5f * (s.sxx - s.syy);
    const Vec major = middle + sqrt_vec(half * half + s.sxy * s.sxy);
    const Vec root_p = sqrt_vec(kHalfLog2E * s.syy * s.inverse_determinant), root_s = sqrt_vec(kHalfLog2E / s.syy);
    const Vec root_r = -root_p * s.sxy / s.syy;
    fine &= is_finite(root_p) & is_finite(root_r) & is_finite(root_s) & is_finite(major);
    const Vec above_cut = log2_above_cut(opacity), reach = sqrt_vec(above_cut * (1.0f / kHalfLog2E));
    const Vec north[3] = {-s.cosine * s.hx, -s.sine, -s.cosine * s.hz};
    Vec edges[4];
    extent_of(view, s, reach, edges);
    const Vec splat[12] = {root_p * s.hz + root_r * north[0],
                           root_r * north[1],
                           root_r * north[2] - root_p * s.hx,
                           root_s * north[0],
                           root_s * north[1],
                           root_s * north[2],
                           s.mx,
                           s.my,
                           s.mz,
                           above_cut + kLog2AlphaMin,
                           s.range,
                           block_reach(view, s, above_cut, major)};
    alignas(64) float radius[kLanes], nobody[12];
    store(radius, reach * sqrt_vec(major) * per_pixel);
    float *splats[kLanes], *extents[kLanes];
    for (int lane = 0; lane < kLanes; ++lane) splats[lane] = extents[lane] = nobody;
    for (uint32_t left = bits_of(fine) & ((1u << lanes) - 1u); left != 0; left &= left - 1) {
      const int lane = __builtin_ctz(left);
      splats[lane] = out.splats + 12 * visible;
      extents[lane] = &out.extents[visible].left;
      out.sources[visible] = static_cast<uint32_t>(start + lane);
      out.radii[start + lane] = radius[lane];
      ++visible;
    }
    store_columns<12>(splat, splats, kLanes);
    store_columns<4>(edges, extents, kLanes);
  }
  return visible;
}

// From the sums of g u (2), g u u^T (3) and g |u|^2 u (2) to the gradients of M = f1 f1^T + f2 f2^T, of which the exponent
// is -1/2 d^T M d / (d.m)^2, and of m: rows of M's xx, xy, xz, yy, yz, zz (as a full symmetric matrix) and of m's x, y, z.
// These do not depend on how the tangent plane's axes were chosen. With d / (d.m) = m + z and z the pixel in the plane,
// d loss / dM = -1/2 sum g (m z^T + z m^T + z z^T), up to a multiple of m m^T which no change of M can have.
void project_sphere_backward(const View& view, const Geometry& in, const uint32_t* sources, const float* sums,
                             size_t count, const GeometryRows& out) {
  for (size_t start = 0; start < count; start += kLanes) {
    const int lanes = static_cast<int>(count - start < kLanes ? count - start : kLanes);
    SphereProjection s;
    project_sphere_lanes(view, in, Chosen{sources + start, lanes}, s);
    // The inverse of the root that made u: z = u_1 (x, 0) + u_2 (skew, y) along east and north, for u in standard
    // deviations.
    const Vec x = sqrt_vec(1.0f / (s.syy * s.inverse_determinant)), y = sqrt_vec(s.syy), skew = s.sxy / y;
    const float scale = 1.0f / __builtin_sqrtf(kHalfLog2E);
    Vec sum[7];
    load_columns_from<7>(sums + 7 * start, lanes, sum);
    const Vec s1 = sum[0] * scale, s2 = sum[1] * scale;
    const Vec s11 = sum[2] * (scale * scale), s12 = sum[3] * (scale * scale), s22 = sum[4] * (scale * scale);
    const Vec s31 = sum[5] * (scale * scale * scale), s32 = sum[6] * (scale * scale * scale);
    const Vec m[3] = {s.mx, s.my, s.mz};
    const Vec east[3] = {s.hz, Vec{}, -s.hx}, north[3] = {-s.cosine * s.hx, -s.sine, -s.cosine * s.hz};
    Vec h1[3], h2[3], z[3], to_m[3];
    for (int axis = 0; axis < 3; ++axis) {
      h1[axis] = x * east[axis];
      h2[axis] = skew * east[axis] + y * north[axis];
      z[axis] = s1 * h1[axis] + s2 * h2[axis];
      to_m[axis] = (s11 + s22) * m[axis] + s31 * h1[axis] + s32 * h2[axis];
    }
    Vec of[9] = {{}, {}, {}, {}, {}, {}, to_m[0], to_m[1], to_m[2]};
    for (int a = 0, column = 0; a < 3; ++a) {
      for (int b = a; b < 3; ++b, ++column) {
        const Vec zz = s11 * h1[a] * h1[b] + s12 * (h1[a] * h2[b] + h2[a] * h1[b]) + s22 * h2[a] * h2[b];
        of[column] = -0.5f * (m[a] * z[b] + z[a] * m[b] + zz);
      }
    }
    store_columns_to<9>(of, out.sphere + 9 * start, lanes);
  }
}

}  // namespace
