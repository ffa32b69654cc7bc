// The rasterizer's numbers, mirrored in src/rf3dgs/splats/constants.py.
#pragma once

namespace rf3dgs {

constexpr int kTileSize = 16;                 // pixels
constexpr float kNear = 0.05f;                // m: Gaussians nearer than this view depth are not drawn
constexpr float kBlur = 0.3f;                 // pixel^2 added to both variances of a projected Gaussian
constexpr float kAlphaMax = 0.99f;            // no Gaussian hides more of what lies behind it
constexpr float kAlphaMin = 1.0f / 255.0f;    // weaker contributions to a pixel are skipped
constexpr float kLog2AlphaMin = -7.994353436858858f;
constexpr float kTransmittanceStop = 1e-4f;   // a pixel stops before the contribution that would bring it below
constexpr float kFieldClamp = 1.3f;           // the Jacobian's x/z and y/z stay within this many half-fields
constexpr float kGateTransmittance = 0.75f;   // the gate counts from the Gaussian that brings a pixel below this
constexpr float kSphereField = 0.2f;          // the sphere shows a Gaussian where the angle's cosine exceeds this
constexpr float kMinQuaternionNorm = 1e-12f;  // shorter quaternions have no direction

constexpr int kSsimRadius = 5;                // pixels
constexpr int kSsimTaps = 2 * kSsimRadius + 1;
constexpr float kSsimSigma = 1.5f;            // pixels
constexpr float kSsimC1 = 0.01f * 0.01f;
constexpr float kSsimC2 = 0.03f * 0.03f;

}  // namespace rf3dgs
