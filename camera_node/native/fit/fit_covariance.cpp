// SPDX-License-Identifier: BSD-3-Clause
#include "fit/fit_covariance.hpp"

#include <cmath>

namespace roundel {

namespace {

/// The Jacobian of the outputs (centre e = c - A g of the outer ellipse, its shape A, and the offset c - e of
/// the disc's centre) with respect to the model's pose (c, A, g), to first order in g.
PoseCovariance output_jacobian(const Parameters& p) {
    const double gx = p[kGx], gy = p[kGy];
    const Vector<kPoseCount> hx{0, 0, gx, gy, 0, p[kAxx], p[kAxy]}, hy{0, 0, 0, gx, gy, p[kAxy], p[kAyy]};
    PoseCovariance J{};
    for (int k = 0; k < kPoseCount; ++k) {
        J[0][k] = -hx[k];
        J[1][k] = -hy[k];
        J[5][k] = hx[k];
        J[6][k] = hy[k];
    }
    for (int k = 0; k < 5; ++k) J[k][k] += 1;
    return J;
}

/// J pose J^T.
PoseCovariance propagate(const PoseCovariance& J, const PoseCovariance& pose) {
    PoseCovariance half{}, whole{};
    for (int a = 0; a < kPoseCount; ++a)
        for (int i = 0; i < kPoseCount; ++i)
            for (int j = 0; j < kPoseCount; ++j) half[a][j] += J[a][i] * pose[i][j];
    for (int a = 0; a < kPoseCount; ++a)
        for (int b = 0; b < kPoseCount; ++b)
            for (int j = 0; j < kPoseCount; ++j) whole[a][b] += half[a][j] * J[b][j];
    return whole;
}

}  // namespace

RoundelFit make_fit(const Parameters& p, const PoseCovariance& pose, int origin_x, int origin_y) {
    const CircleImage outer = circle_image(p, 1);
    const Eigen axes = eigen(outer.shape);
    RoundelFit fit{};
    fit.outer = {outer.x + origin_x, outer.y + origin_y, 2 * std::sqrt(axes.first),
                 2 * std::sqrt(axes.second), axes.angle};
    fit.offset_x = p[kX] - outer.x;
    fit.offset_y = p[kY] - outer.y;
    fit.pose_cov = propagate(output_jacobian(p), pose);
    fit.ratio = p[kRatio];
    fit.dark = p[kDark];
    fit.bright = p[kBright];
    fit.blur = p[kBlur];
    fit.p = p;
    fit.p[kX] += origin_x;
    fit.p[kY] += origin_y;
    return fit;
}

}  // namespace roundel
