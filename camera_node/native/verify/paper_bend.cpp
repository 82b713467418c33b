// SPDX-License-Identifier: BSD-3-Clause
#include "verify/paper_bend.hpp"

#include <algorithm>
#include <array>
#include <cmath>

#include "fit/gauss_newton.hpp"
#include "verify/learning.hpp"

namespace roundel {

namespace {

// The picture shows a tilt against the image plane. Against the line of sight, it may differ by this
// (tangent; 15 degrees off the optical axis).
constexpr double kUnknownTilt = 0.15;
// Squared bends over the tangent of the tilt:
constexpr double kSmallBend = 1e-6;  // of paper bent by 0.25 % of its width, from which roundels count alike
constexpr double kChance = 2;        // standard deviations of a mean that noise explains
// Squared displacements over the squared length of the bend that shows:
constexpr double kMeanBend = 4;      // that of the mean curvature, along the tilt
constexpr double kOtherBend = 0.09;  // deviations from a cylinder
constexpr double kComponent = 0.5;   // one of the two components that show

double squared_tilt(const FieldFrame& frame) { return square(frame.tilt()) + square(kUnknownTilt); }

void add_outer_product(const Vector<kPoseCount>& v, double factor, PoseCovariance& to) {
    for (size_t i = 0; i < kPoseCount; ++i)
        for (size_t j = 0; j < kPoseCount; ++j) to[i][j] += factor * v[i] * v[j];
}

}  // namespace

double PaperBend::Sums::lower() const {
    return weight > 0 ? std::max(0.0, excess - kChance * std::sqrt(scatter)) / weight : 0;
}

void PaperBend::learn(const std::vector<const RoundelFit*>& fits, double correlation) {
    Sums now;
    for (const RoundelFit* fit : fits) {
        if (!(fit->bend.variance > 0)) continue;
        const double tilt = squared_tilt(FieldFrame(fit->p));
        const double noise = 2 * fit->bend.variance * correlation / tilt;
        const double weight = 1 / square(noise + kSmallBend);
        now.weight += weight;
        now.scatter += square(weight * noise);
        now.excess += weight * (fit->bend.squared / tilt - noise);
    }
    if (!(now.weight > 0)) return;
    remembered_.weight = (1 - kNewFrame) * remembered_.weight + now.weight;
    remembered_.excess = (1 - kNewFrame) * remembered_.excess + now.excess;
    remembered_.scatter = (1 - kNewFrame) * remembered_.scatter + now.scatter;
    // Other prints may be in view than before.
    squared_ = std::max(now.lower(), remembered_.lower());
}

/// The expected squared length of a bend that the fit does not contain, given the roundel's own residuals; if
/// the fit contains a bend, that one.
double PaperBend::unseen(const RoundelFit& fit, double tilt) const {
    if (fit.fields.bend() > 0) return square(fit.fields.bend());
    const double prior = squared_ * tilt / 2, variance = fit.bend.variance;
    if (!(prior > 0)) return 0;
    if (!(variance > 0)) return 2 * prior;
    const double share = prior / (prior + variance);
    return square(share) * fit.bend.squared + 2 * share * variance;
}

void PaperBend::claim(RoundelFit& fit) const {
    const FieldFrame frame(fit.p);
    const double tilt = squared_tilt(frame), bend = unseen(fit, tilt);
    if (!(bend > 0)) return;
    // It displaces as a perspective g does: the ellipse's centre by -A g, its offset by A g.
    const double rest = kOtherBend + (fit.fields.bend() > 0 ? 0 : kComponent);
    const double across = kMeanBend / 2 * square(kUnknownTilt) / tilt, along = kMeanBend - across;
    const double x = frame.minor * frame.cos, y = frame.minor * frame.sin;
    const double u = -frame.major * frame.sin, v = frame.major * frame.cos;
    add_outer_product({-x, -y, 0, 0, 0, x, y}, bend * (along + rest), fit.pose_cov);
    add_outer_product({-u, -v, 0, 0, 0, u, v}, bend * (across + rest), fit.pose_cov);
    // The mean height moves the disc towards the camera.
    const double nearer = frame.major / kShortestFocal;
    const Parameters& p = fit.p;
    add_outer_product({0, 0, p[kAxx], p[kAxy], p[kAyy], 0, 0}, kMeanBend * bend / tilt * square(nearer),
                      fit.pose_cov);
}

}  // namespace roundel
