// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "detector.hpp"

namespace roundel {

/// The roundels of a frame as named columns, row-major; `_core.pyi` gives the shapes and units.
struct FrameColumns {
    std::vector<double> uv, axes_px, angle_rad, ratio, contrast, offset_px, pose_cov, id_probability,
        rotation_rad, rotation_sigma;
    std::vector<int32_t> track, id;

    explicit FrameColumns(const std::vector<TrackedFit>& roundels) {
        for (auto* column : {&uv, &axes_px, &offset_px}) column->reserve(2 * roundels.size());
        pose_cov.reserve(kPoseCount * kPoseCount * roundels.size());
        for (const auto& [fit, number, code] : roundels) {
            uv.insert(uv.end(), {fit.outer.x, fit.outer.y});
            axes_px.insert(axes_px.end(), {fit.outer.major, fit.outer.minor});
            angle_rad.push_back(fit.outer.angle);
            ratio.push_back(fit.ratio);
            contrast.push_back(fit.contrast());
            offset_px.insert(offset_px.end(), {fit.offset_x, fit.offset_y});
            for (int i = 0; i < kPoseCount; ++i)  // rounding makes the halves differ: the upper one counts
                for (int j = 0; j < kPoseCount; ++j)
                    pose_cov.push_back(fit.pose_cov[size_t(std::min(i, j))][size_t(std::max(i, j))]);
            track.push_back(number);
            id.push_back(code.name ? code.name : -1);
            id_probability.push_back(code.name ? code.probability : NAN);
            rotation_rad.push_back(code.name ? code.rotation : NAN);
            rotation_sigma.push_back(code.name ? code.sigma : NAN);
        }
    }
};

}  // namespace roundel
