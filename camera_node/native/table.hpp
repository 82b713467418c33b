// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <array>
#include <cstddef>

#include "tracks.hpp"

namespace roundel {

constexpr size_t kPlainColumns = 10, kColumns = kPlainColumns + kPoseCount * (kPoseCount + 1) / 2;

/// What a roundel's row tells, in the order that `_core.pyi` states.
inline std::array<double, kColumns> row_of(const Roundel& roundel) {
    const Fit& f = roundel.fit;
    std::array<double, kColumns> row{
        f.outer.x, f.outer.y,         f.outer.major, f.outer.minor, f.outer.angle,
        f.ratio,   f.bright - f.dark, f.offset_x,    f.offset_y,    double(roundel.track)};
    size_t at = kPlainColumns;
    for (size_t i = 0; i < kPoseCount; ++i)
        for (size_t j = i; j < kPoseCount; ++j) row[at++] = f.C[i][j];
    return row;
}

}  // namespace roundel
