// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "outline.hpp"

namespace roundel::fusion {

constexpr int kErrors = 12;  // of a state: turn (body's frame), position, turning rate, velocity (world)

/// Two whitened linear equations A delta = b of a body's error, each as its row of A and then b.
/// What can't be seen has zeros.
struct Rows {
    double A[2][kErrors + 1];
};

/// N detections of discs: undistorted centres, and what takes errors of these to a standard deviation of 1.
struct Centres {
    Discs discs;
    Columns<2> xy;
    Columns<4> whiten;
    const bool* single;  // by body: one of one marker, whose turning rate would but fit its noise
};

/// The equations that N centres give.
void linearise(const Poses& poses, const Centres& seen, Rows* to);

/// N outlines: full axes and the major one's direction, and the standard deviation of a shear.
struct Outlines {
    Discs discs;
    Columns<2> axes;
    const double* angle;
    Columns<4> scale;
    const double* sigma;
};

/// The equations that N outlines give: how they are stretched tells the normal where few markers do; their
/// sizes, prone to blur, are left out.
void linearise(const Poses& poses, const Outlines& seen, Rows* to);

}  // namespace roundel::fusion
