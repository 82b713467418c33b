// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <array>

#include "lens/lens.hpp"
#include "numeric/cholesky.hpp"
#include "numeric/ellipse.hpp"

namespace roundel {

/// What a fit measures of a disc without knowing the lens, pixels: the outer ellipse, the offset from its
/// centre to the image of the disc's centre, and the covariance (7, 7) of the ellipse's centre x, y, its
/// shape Axx, Axy, Ayy (the ellipse is centre + A u, |u| = 1) and the offset x, y.
struct DiscMeasurement {
    static constexpr int kCount = 7;
    Ellipse outer;
    Point offset;
    std::array<Vector<kCount>, kCount> covariance;
};

/// The outer ellipse given the lens, and the covariance of its centre, square pixels.
struct ConstrainedEllipse {
    Ellipse outer;
    Symmetric covariance;
    /// Squared error, over its variance, by which the measurement contradicts the lens: chi-square with two
    /// degrees of freedom. NaN where it could not be computed: the ellipse is the measured one then.
    double chi2;
};

/// Conditions a measurement on the knowledge that it is the picture of a circle of any size through this
/// lens: five unknowns (position in radii, normal) for seven numbers (detector_model.md, section 9a).
///
/// `lens_sigma` is the standard deviation of the lens's error, relative to the offset's greatest size. A
/// measurement that contradicts the lens is returned as it is.
ConstrainedEllipse constrain_to_lens(const DiscMeasurement& measured, const Lens& lens, double lens_sigma);

}  // namespace roundel
