// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <algorithm>
#include <cstdint>
#include <vector>

#include "detector.hpp"

namespace roundel {

/// The roundels of a frame as named columns, row-major; `_core.pyi` gives the shapes and units.
struct FrameColumns {
    std::vector<double> uv, axes_px, angle_rad, ratio, contrast, offset_px, pose_cov;
    std::vector<int32_t> track;

    explicit FrameColumns(const std::vector<TrackedFit>& roundels) {
        for (auto* column : {&uv, &axes_px, &offset_px}) column->reserve(2 * roundels.size());
        pose_cov.reserve(kPoseCount * kPoseCount * roundels.size());
        for (const auto& [fit, number] : roundels) {
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
        }
    }
};

}  // namespace roundel
