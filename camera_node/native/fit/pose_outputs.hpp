// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <cmath>

#include "fit/photometric_fit.hpp"
#include "fit/roundel_model.hpp"

namespace roundel {

/// By the model's pose: the outer ellipse's centre e = c - A g, its shape and the disc's own centre less e,
/// to first order in g.
inline std::array<Vector<kPoseCount>, kPoseCount> outputs_by_pose(const Parameters& p) {
    const double gx = p[kGx], gy = p[kGy];
    const Vector<kPoseCount> hx{0, 0, gx, gy, 0, p[kAxx], p[kAxy]}, hy{0, 0, 0, gx, gy, p[kAxy], p[kAyy]};
    std::array<Vector<kPoseCount>, kPoseCount> T{};
    for (int k = 0; k < kPoseCount; ++k) T[0][k] = -hx[k], T[1][k] = -hy[k], T[5][k] = hx[k], T[6][k] = hy[k];
    for (int k = 0; k < 5; ++k) T[k][k] += 1;
    return T;
}

/// The covariance of the outputs, from that of the model's pose.
inline PoseCovariance output_covariance(const Parameters& p,
                                        const std::array<Vector<kPoseCount>, kPoseCount>& pose) {
    const auto T = outputs_by_pose(p);
    PoseCovariance half{}, whole{};
    for (int a = 0; a < kPoseCount; ++a)
        for (int i = 0; i < kPoseCount; ++i)
            for (int j = 0; j < kPoseCount; ++j) half[a][j] += T[a][i] * pose[i][j];
    for (int a = 0; a < kPoseCount; ++a)
        for (int b = 0; b < kPoseCount; ++b)
            for (int j = 0; j < kPoseCount; ++j) whole[a][b] += half[a][j] * T[b][j];
    return whole;
}

/// A fit of what the parameters say, in the image's frame: `p` is in one of origin x, y, and `pose` the
/// covariance of its pose.
inline Fit fit_of(const Parameters& p, const std::array<Vector<kPoseCount>, kPoseCount>& pose, int origin_x,
                  int origin_y) {
    const CircleImage outer = circle_image(p, 1);
    const Eigen axes = eigen(outer.shape);
    Fit fit{};
    fit.outer = {outer.x + origin_x, outer.y + origin_y, 2 * std::sqrt(axes.first),
                 2 * std::sqrt(axes.second), axes.angle};
    fit.offset_x = p[kX] - outer.x, fit.offset_y = p[kY] - outer.y;
    fit.C = output_covariance(p, pose);
    fit.ratio = p[kRatio], fit.dark = p[kDark], fit.bright = p[kBright], fit.blur = p[kBlur];
    fit.p = p, fit.p[kX] += origin_x, fit.p[kY] += origin_y;
    return fit;
}

}  // namespace roundel
