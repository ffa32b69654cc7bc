// Projection of Gaussians to the screen and its derivative, sixteen Gaussians at a time.
//
//   p = W mu + t,  u = x/z, v = y/z (clamped),  T = J W with J = [fx/z, 0, -fx u/z; 0, fy/z, -fy v/z],
//   A = T R S,  Sigma2 = A A^T + blur,  conic = Sigma2^-1.
//
// The determinant is blur^2 + blur (|a0|^2 + |a1|^2) + |a0 x a1|^2, which needles cannot cancel.
#pragma once

#include "core/rows.hpp"
#include "core/vector.hpp"
#include "splats/constants.hpp"
#include "splats/kernels.hpp"
#include "splats/kernels_bounds.hpp"

namespace {

using namespace rf3dgs;

// A Gaussian on the screen: log2 of its alpha at d = pixel - (x, y) is peak - (p dx + r dy)^2 - (s dy)^2.
struct PinholeSplat {
  float x, y, p, r, s, peak, depth, unused;
};

struct Projection {
  Vec x, y, z;           // in the camera
  Vec inverse_z;
  Vec qw, qx, qy, qz;    // unit quaternion
  Vec inverse_norm;
  Vec r[9];              // rotation of the quaternion
  Vec s[3];
  Vec u, v;
  IntVec u_free, v_free;  // where the clamp lets gradients through
  Vec t[6];              // T, two rows
  Vec a[6];              // A, two rows
  Vec sxx, sxy, syy, inverse_determinant;
  Vec screen_x, screen_y;
  IntVec fine;           // a Gaussian that can be drawn
};

constexpr float kHalfLog2E = 0.5f * 1.442695040888963f;

// log2(opacity / cut), how far alpha may fall before it reaches the cut, for opacities from the cut to one. With
// x = 2^e m and m between sqrt(1/2) and sqrt(2), ln m = 2 artanh s, s = (m - 1) / (m + 1).
RF_INLINE Vec log2_above_cut(Vec opacity) {
  const Vec x = max_vec(opacity * (1.0f / kAlphaMin), splat_vec(1.0f));
  const IntVec bits = int_bits(x);
  const IntVec exponent = (bits + -0x3f3504f3) & -0x800000;
  const Vec m = float_bits(bits - exponent), s = (m - 1.0f) / (m + 1.0f), ss = s * s;
  const Vec series = 1.0f + ss * (1.0f / 3.0f + ss * (0.2f + ss * (1.0f / 7.0f + ss * (1.0f / 9.0f))));
  return (4.0f * kHalfLog2E) * s * series + to_float(exponent) * (1.0f / 0x800000);
}

RF_INLINE IntVec is_finite(Vec value) { return (int_bits(value) & 0x7f800000) != 0x7f800000; }

// Where Gaussians lie in the camera and how wide they are.
template <class Which>
RF_INLINE void place_lanes(const View& view, const Geometry& in, const Which& which, Projection& p) {
  const float* w = view.rotation;
  Vec mean[3];
  which.template columns<3>(in.means, mean);
  p.x = w[0] * mean[0] + w[1] * mean[1] + w[2] * mean[2] + view.translation[0];
  p.y = w[3] * mean[0] + w[4] * mean[1] + w[5] * mean[2] + view.translation[1];
  p.z = w[6] * mean[0] + w[7] * mean[1] + w[8] * mean[2] + view.translation[2];
  p.fine = is_finite(p.x) & is_finite(p.y) & is_finite(p.z);
  which.template columns<3>(in.scales, p.s);
}

// How they are turned.
template <class Which>
RF_INLINE void turn_lanes(const Geometry& in, const Which& which, Projection& p) {
  Vec quat[4];
  which.template columns<4>(in.quats, quat);
  const Vec qw = quat[0], qx = quat[1], qy = quat[2], qz = quat[3];
  const Vec norm = sqrt_vec(qw * qw + qx * qx + qy * qy + qz * qz);
  p.fine &= (norm > kMinQuaternionNorm) & is_finite(norm);
  p.inverse_norm = 1.0f / norm;
  p.qw = qw * p.inverse_norm;
  p.qx = qx * p.inverse_norm;
  p.qy = qy * p.inverse_norm;
  p.qz = qz * p.inverse_norm;
  p.r[0] = 1.0f - 2.0f * (p.qy * p.qy + p.qz * p.qz);
  p.r[1] = 2.0f * (p.qx * p.qy - p.qw * p.qz);
  p.r[2] = 2.0f * (p.qx * p.qz + p.qw * p.qy);
  p.r[3] = 2.0f * (p.qx * p.qy + p.qw * p.qz);
  p.r[4] = 1.0f - 2.0f * (p.qx * p.qx + p.qz * p.qz);
  p.r[5] = 2.0f * (p.qy * p.qz - p.qw * p.qx);
  p.r[6] = 2.0f * (p.qx * p.qz - p.qw * p.qy);
  p.r[7] = 2.0f * (p.qy * p.qz + p.qw * p.qx);
  p.r[8] = 1.0f - 2.0f * (p.qx * p.qx + p.qy * p.qy);
  for (int axis = 0; axis < 3; ++axis) p.fine &= (p.s[axis] >= 0.0f);
}

// Where the centres are, in the camera and on the screen.
template <class Which>
RF_INLINE void project_centres(const View& view, const Geometry& in, const Which& which, Projection& p) {
  place_lanes(view, in, which, p);
  p.fine &= p.z > kNear;
  p.inverse_z = 1.0f / p.z;
  const Vec u = p.x * p.inverse_z, v = p.y * p.inverse_z;
  p.u_free = (u >= view.u_low) & (u <= view.u_high);
  p.v_free = (v >= view.v_low) & (v <= view.v_high);
  p.u = clamp_vec(u, splat_vec(view.u_low), splat_vec(view.u_high));
  p.v = clamp_vec(v, splat_vec(view.v_low), splat_vec(view.v_high));
  p.screen_x = view.fx * u + view.cx;
  p.screen_y = view.fy * v + view.cy;
}

// Whether any of the Gaussians may touch the picture: the rows of J have the lengths fx sqrt(1 + u^2) / z and
// fy sqrt(1 + v^2) / z, and no Gaussian is longer than its largest scale.
RF_INLINE bool may_be_seen(const View& view, const Vec& opacity, const Projection& p) {
  const Vec scale = max_vec(p.s[0], max_vec(p.s[1], p.s[2])) * p.inverse_z, scale2 = scale * scale * (1.01f * kReach2);
  const Vec wide = sqrt_vec(scale2 * (view.fx * view.fx) * (1.0f + p.u * p.u) + kReach2 * view.blur) + 1.0f;
  const Vec tall = sqrt_vec(scale2 * (view.fy * view.fy) * (1.0f + p.v * p.v) + kReach2 * view.blur) + 1.0f;
  const Vec width = splat_vec(static_cast<float>(view.width)), height = splat_vec(static_cast<float>(view.height));
  const IntVec beside = (p.screen_x + wide < 0.0f) | (p.screen_x - wide > width) | (p.screen_y + tall < 0.0f) |
                        (p.screen_y - tall > height);
  return (bits_of(p.fine & (opacity >= kAlphaMin)) & ~bits_of(beside)) != 0;
}

// The rest of the projection, after the centres.
template <class Which>
RF_INLINE void project_shapes(const View& view, const Geometry& in, const Which& which, Projection& p) {
  const float* w = view.rotation;
  turn_lanes(in, which, p);
  const Vec jx = view.fx * p.inverse_z, jy = view.fy * p.inverse_z;
  for (int col = 0; col < 3; ++col) {
    p.t[col] = jx * (w[col] - p.u * w[6 + col]);
    p.t[3 + col] = jy * (w[3 + col] - p.v * w[6 + col]);
  }
  for (int row = 0; row < 2; ++row) {
    for (int col = 0; col < 3; ++col) {
      const Vec* t = p.t + 3 * row;
      p.a[3 * row + col] = (t[0] * p.r[col] + t[1] * p.r[3 + col] + t[2] * p.r[6 + col]) * p.s[col];
    }
  }
  const Vec* a = p.a;
  const Vec first = a[0] * a[0] + a[1] * a[1] + a[2] * a[2];
  const Vec second = a[3] * a[3] + a[4] * a[4] + a[5] * a[5];
  const Vec c0 = a[1] * a[5] - a[2] * a[4], c1 = a[2] * a[3] - a[0] * a[5], c2 = a[0] * a[4] - a[1] * a[3];
  const Vec determinant = view.blur * view.blur + view.blur * (first + second) + (c0 * c0 + c1 * c1 + c2 * c2);
  p.sxx = first + view.blur;
  p.syy = second + view.blur;
  p.sxy = a[0] * a[3] + a[1] * a[4] + a[2] * a[5];
  p.fine &= is_finite(determinant);
  p.inverse_determinant = 1.0f / determinant;
}

// Sixteen neighbours from `start` on; `visible` counts the splats that are written.
RF_INLINE void project_group(const View& view, const Geometry& in, size_t start, size_t end, const Projected& out,
                             size_t& visible) {
  const int lanes = static_cast<int>(end - start < kLanes ? end - start : kLanes);
  const Neighbours which = {start, lanes};
  Projection p;
  project_centres(view, in, which, p);
  const Vec opacity = load_some(in.opacities + start, lanes);
  if (in.offset != nullptr) {
    Vec offset[2];
    which.template columns<2>(in.offset, offset);
    p.screen_x += offset[0];
    p.screen_y += offset[1];
  }
  if (!may_be_seen(view, opacity, p)) return;
  project_shapes(view, in, which, p);
  IntVec fine = p.fine & (opacity >= kAlphaMin) & is_finite(opacity);
  fine &= is_finite(p.screen_x) & is_finite(p.screen_y);
  const Vec middle = 0.5f * (p.sxx + p.syy), half = 0.5f * (p.sxx - p.syy);
  const Vec major = middle + sqrt_vec(half * half + p.sxy * p.sxy);
  // Half of d^T Sigma2^-1 d is |(p dx + r dy, s dy)|^2 with a triangular root, which does not cancel.
  const Vec root_p = sqrt_vec(kHalfLog2E * p.syy * p.inverse_determinant), root_s = sqrt_vec(kHalfLog2E / p.syy);
  const Vec root_r = -root_p * p.sxy / p.syy;
  fine &= is_finite(root_p) & is_finite(root_r) & is_finite(root_s) & is_finite(major);
  const Vec above_cut = log2_above_cut(opacity), reach = sqrt_vec(above_cut * (1.0f / kHalfLog2E));
  const Vec box_x = reach * sqrt_vec(p.sxx), box_y = reach * sqrt_vec(p.syy);
  const Vec extent[4] = {p.screen_x - box_x, p.screen_y - box_y, p.screen_x + box_x, p.screen_y + box_y};
  fine &= (extent[2] > 0.0f) & (extent[0] < static_cast<float>(view.width));
  fine &= (extent[3] > 0.0f) & (extent[1] < static_cast<float>(view.height));
  const Vec splat[8] = {p.screen_x, p.screen_y, root_p, root_r, root_s, above_cut + kLog2AlphaMin, p.z, Vec{}};
  alignas(64) float radius[kLanes], nobody[8];
  store(radius, reach * sqrt_vec(major));
  const uint32_t seen = bits_of(fine) & ((1u << lanes) - 1u);
  float *splats[kLanes], *extents[kLanes];
  for (int lane = 0; lane < kLanes; ++lane) splats[lane] = extents[lane] = nobody;
  for (uint32_t left = seen; left != 0; left &= left - 1) {
    const int lane = __builtin_ctz(left);
    splats[lane] = out.splats + 8 * visible;
    extents[lane] = &out.extents[visible].left;
    out.sources[visible] = static_cast<uint32_t>(start + lane);
    out.radii[start + lane] = radius[lane];
    ++visible;
  }
  store_columns<8>(splat, splats, kLanes);
  store_columns<4>(extent, extents, kLanes);
}

size_t project(const View& view, const Geometry& in, size_t gaussians, size_t begin, size_t end, const Projected& out) {
  size_t visible = 0;
  std::memset(out.radii + begin, 0, (end - begin) * sizeof(float));
  const Sides sides(view);
  const bool bounded = in.bounds != nullptr && in.offset == nullptr;
  for (size_t start = begin; start < end; start += kLanes * kBoundGroup) {
    uint32_t left = 0xffff;
    if (bounded) left = sides.seen(in.bounds, bound_groups(gaussians), start / kBoundGroup);
    for (; left != 0; left &= left - 1) {
      const size_t first = start + __builtin_ctz(left) * kBoundGroup;
      if (first >= end) break;
      project_group(view, in, first, end, out, visible);
    }
  }
  return visible;
}

void project_backward(const View& view, const Geometry& in, const uint32_t* sources, const float* sums, size_t count,
                      const GeometryRows& out) {
  const float* w = view.rotation;
  for (size_t start = 0; start < count; start += kLanes) {
    const int lanes = static_cast<int>(count - start < kLanes ? count - start : kLanes);
    const Chosen which = {sources + start, lanes};
    Projection p;
    project_centres(view, in, which, p);
    project_shapes(view, in, which, p);
    const Vec qa = p.syy * p.inverse_determinant, qb = -p.sxy * p.inverse_determinant;
    const Vec qc = p.sxx * p.inverse_determinant;
    Vec sum[5];
    load_columns_from<5>(sums + 5 * start, lanes, sum);
    const Vec gx = qa * sum[0] + qb * sum[1], gy = qb * sum[0] + qc * sum[1];
    const Vec ga = -0.5f * sum[2], gb = -0.5f * sum[3], gc = -0.5f * sum[4];

    // D = -Q G Q, the gradient with respect to Sigma2.
    const Vec h00 = ga * qa + gb * qb, h01 = ga * qb + gb * qc, h10 = gb * qa + gc * qb, h11 = gb * qb + gc * qc;
    const Vec d00 = -(qa * h00 + qb * h10), d01 = -(qa * h01 + qb * h11), d11 = -(qb * h01 + qc * h11);

    Vec da[6], dt[6];
    for (int col = 0; col < 3; ++col) {
      da[col] = 2.0f * (d00 * p.a[col] + d01 * p.a[3 + col]);
      da[3 + col] = 2.0f * (d01 * p.a[col] + d11 * p.a[3 + col]);
    }
    Vec dr[9], ds[3];
    for (int row = 0; row < 3; ++row) {
      dt[row] = dt[3 + row] = Vec{};
      for (int col = 0; col < 3; ++col) {
        const Vec m = p.r[3 * row + col] * p.s[col];
        dt[row] += da[col] * m;
        dt[3 + row] += da[3 + col] * m;
        dr[3 * row + col] = p.t[row] * da[col] + p.t[3 + row] * da[3 + col];
      }
    }
    for (int col = 0; col < 3; ++col) {
      ds[col] = dr[col] * p.r[col] + dr[3 + col] * p.r[3 + col] + dr[6 + col] * p.r[6 + col];
      for (int row = 0; row < 3; ++row) dr[3 * row + col] *= p.s[col];
    }
    Vec dw = 2.0f * (-p.qz * dr[1] + p.qy * dr[2] + p.qz * dr[3] - p.qx * dr[5] - p.qy * dr[6] + p.qx * dr[7]);
    Vec dx = 2.0f * (p.qy * dr[1] + p.qz * dr[2] + p.qy * dr[3] - 2.0f * p.qx * dr[4] - p.qw * dr[5] + p.qz * dr[6] +
                     p.qw * dr[7] - 2.0f * p.qx * dr[8]);
    Vec dy = 2.0f * (-2.0f * p.qy * dr[0] + p.qx * dr[1] + p.qw * dr[2] + p.qx * dr[3] + p.qz * dr[5] - p.qw * dr[6] +
                     p.qz * dr[7] - 2.0f * p.qy * dr[8]);
    Vec dz = 2.0f * (-2.0f * p.qz * dr[0] - p.qw * dr[1] + p.qx * dr[2] + p.qw * dr[3] - 2.0f * p.qz * dr[4] +
                     p.qy * dr[5] + p.qx * dr[6] + p.qy * dr[7]);
    const Vec along = dw * p.qw + dx * p.qx + dy * p.qy + dz * p.qz;
    dw = (dw - p.qw * along) * p.inverse_norm;
    dx = (dx - p.qx * along) * p.inverse_norm;
    dy = (dy - p.qy * along) * p.inverse_norm;
    dz = (dz - p.qz * along) * p.inverse_norm;

    const Vec inverse_z = p.inverse_z;
    const Vec jx = view.fx * inverse_z, jy = view.fy * inverse_z;
    const Vec j00 = w[0] * dt[0] + w[1] * dt[1] + w[2] * dt[2], j02 = w[6] * dt[0] + w[7] * dt[1] + w[8] * dt[2];
    const Vec j11 = w[3] * dt[3] + w[4] * dt[4] + w[5] * dt[5], j12 = w[6] * dt[3] + w[7] * dt[4] + w[8] * dt[5];
    const Vec none = Vec{};
    const Vec du = select(p.u_free, -jx * j02, none), dv = select(p.v_free, -jy * j12, none);
    const Vec px = inverse_z * du + jx * gx;
    const Vec py = inverse_z * dv + jy * gy;
    const Vec pz = inverse_z * (-jx * j00 - jy * j11 + jx * p.u * j02 + jy * p.v * j12) -
                   inverse_z * inverse_z * (p.x * du + p.y * dv) -
                   inverse_z * inverse_z * (view.fx * p.x * gx + view.fy * p.y * gy);
    Vec mean[3];
    for (int col = 0; col < 3; ++col) mean[col] = w[col] * px + w[3 + col] * py + w[6 + col] * pz;
    const Vec quat[4] = {dw, dx, dy, dz}, offset[2] = {gx, gy};
    store_columns_to<3>(mean, out.means + 3 * start, lanes);
    store_columns_to<4>(quat, out.quats + 4 * start, lanes);
    store_columns_to<3>(ds, out.scales + 3 * start, lanes);
    store_columns_to<2>(offset, out.offset + 2 * start, lanes);
  }
}

}  // namespace
