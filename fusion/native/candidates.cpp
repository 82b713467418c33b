// SPDX-License-Identifier: BSD-3-Clause
#include "candidates.hpp"

#include <algorithm>

#include "linearization.hpp"

namespace roundel::fusion {
namespace {

constexpr double kGate = 13.8;  // chi-square with 2 degrees of freedom; rejects one true detection in 1000
constexpr double kSizeRatio = 1.35;  // largest ratio of the measured and the predicted major axis
constexpr double kSizeSigma = 0.05;  // of the logarithm of this ratio at a known distance
constexpr double kGrazing = 0.1;     // smallest cosine of viewing direction and normal of a detectable print
constexpr double kInfinity = std::numeric_limits<double>::infinity();
constexpr double kTinyPx2 = 1e-6;  // lower bound of a squared half axis, for discs closer than their radius

/// A detection in the undistorted plane.
struct Detection {
    double x, y, delay;
    Symmetric noise;
    int64_t index;
};

Matrix block(const double* P, int row, int column) {
    const auto at = [&](int i) {
        const double* p = P + 12 * (row + i) + column;
        return Vector{p[0], p[1], p[2]};
    };
    return {at(0), at(1), at(2)};
}

/// -[w]x: the derivative of w x e by e, negated.
Matrix minus_skew(const Vector& w) { return {{0, w.z, -w.y}, {-w.z, 0, w.x}, {w.y, -w.x, 0}}; }

/// A displacement A e_a + e_b, where e_a and e_b are the parts of a state error at these rows.
struct Displacement {
    Matrix A;
    int a, b;
};

Displacement displacement_by_pose(const Vector& position, const Matrix& R) {
    return {R * minus_skew(position), kTheta, kPosition};
}

Matrix cross_covariance(const double* P, const Displacement& u, const Displacement& v) {
    const Matrix A_T = transposed(v.A);
    return (u.A * block(P, u.a, v.a) + block(P, u.b, v.a)) * A_T + u.A * block(P, u.a, v.b) +
           block(P, u.b, v.b);
}

/// The covariance of detection `k` including the calibration error, in the undistorted plane.
Symmetric noise_of(const Detections& detections, size_t k) {
    const Symmetric pixels{detections.cov.at(0, k) + kSlackPx * kSlackPx, detections.cov.at(1, k),
                           detections.cov.at(3, k) + kSlackPx * kSlackPx};
    return mapped(scale_at(detections.scale, k).inverse(), pixels);
}

/// The predicted view of a marker in one frame, and its covariance.
struct ExpectedView {
    DiscView at;
    double radius;
    Symmetric covariance;
    double log_size_variance;
    double vx;  // of the image, 1/s: a row captured later shows the marker farther along
    double vy;  // of the image, 1/s
};

double norm(const Vector& v) { return std::sqrt(dot(v, v)); }
double trace(const Matrix& A) { return A.r0.x + A.r1.y + A.r2.z; }

/// The detections of one frame, sorted by x for range queries.
class FrameDetections {
  public:
    FrameDetections(const Detections& detections, size_t first, size_t last) {
        for (size_t k = first; k < last; ++k) {
            const Symmetric noise = noise_of(detections, k);
            if (!std::isfinite(detections.xy.at(0, k) + noise.xx + noise.yy)) continue;
            sorted_.push_back(
                {detections.xy.at(0, k), detections.xy.at(1, k), detections.delay[k], noise, int64_t(k)});
            max_xx_ = std::max(max_xx_, noise.xx);
            max_yy_ = std::max(max_yy_, noise.yy);
            max_delay_ = std::max(max_delay_, std::abs(detections.delay[k]));
            low_y_ = std::min(low_y_, detections.xy.at(1, k));
            high_y_ = std::max(high_y_, detections.xy.at(1, k));
        }
        std::sort(sorted_.begin(), sorted_.end(), [](const auto& a, const auto& b) { return a.x < b.x; });
    }
    /// Whether no marker of a group can have a detection in its gate.
    ///
    /// A gate is S sqrt(1 + x^2)/z wide beside noise, where S is the displacement of a marker by its position
    /// and time errors. So a marker at x > X is outside that of X if (z - S)(x - X) > S sqrt(1 + X^2), since
    /// sqrt(1 + x^2) < sqrt(1 + X^2) + x - X; for z > 2 S it suffices that z (x - X) > 2 S sqrt(1 + X^2).
    bool excludes(const ExpectedMarkers::Group& group, const Body& body, const Exposure& exposure) const {
        if (sorted_.empty()) return true;
        const double tau = exposure.tau, gate = std::sqrt(kGate);
        const Vector c = exposure.R_cam_world * (body.p + tau * body.v - exposure.centre);
        if (c.z + group.radius <= 0) return true;
        const double speed = norm(body.v) + norm(body.omega) * group.radius;
        const double variance = group.at + std::abs(tau) * group.rate + tau * tau * group.drift;
        const double S = gate * std::sqrt(variance) + (max_delay_ + gate * exposure.tau_sigma) * speed;
        if (!(c.z - group.radius > 2 * S)) return false;
        const double reach = group.radius + 2 * S, noise_x = gate * std::sqrt(max_xx_),
                     noise_y = gate * std::sqrt(max_yy_);
        const auto is_beyond = [&](double along, double bound) {
            return along - bound * c.z > reach * std::sqrt(1 + bound * bound);
        };
        return is_beyond(c.x, sorted_.back().x + noise_x) || is_beyond(-c.x, noise_x - sorted_.front().x) ||
               is_beyond(c.y, high_y_ + noise_y) || is_beyond(-c.y, noise_y - low_y_);
    }
    /// Calls `visit` for a superset of the detections within the gate of a moving point.
    template <class Visit>
    void visit_near(const ExpectedView& expected, const Visit& visit) const {
        const double x = expected.at.x, y = expected.at.y;
        const double reach_x =
            std::sqrt(kGate * (expected.covariance.xx + max_xx_)) + max_delay_ * std::abs(expected.vx);
        const double reach_y =
            std::sqrt(kGate * (expected.covariance.yy + max_yy_)) + max_delay_ * std::abs(expected.vy);
        auto at = std::lower_bound(sorted_.begin(), sorted_.end(), x - reach_x,
                                   [](const Detection& d, double value) { return d.x < value; });
        for (; at != sorted_.end() && at->x < x + reach_x; ++at)
            if (std::abs(at->y - y) < reach_y) visit(*at);
    }

  private:
    std::vector<Detection> sorted_;
    double max_xx_ = 0, max_yy_ = 0, max_delay_ = 0, low_y_ = kInfinity, high_y_ = -kInfinity;
};

double square(double x) { return x * x; }

ExpectedView expect(const ExpectedMarker& marker, const BodyInCamera& body, const Exposure& exposure) {
    const DiscView at = view_disc(body, marker.disc);
    const Matrix C = marker.covariance(exposure.tau), &R = exposure.R_cam_world;
    const Vector gx = (1 / at.centre.z) * (R.r0 - at.x * R.r2), gy = (1 / at.centre.z) * (R.r1 - at.y * R.r2);
    const double depth_variance = dot(R.r2 * C, R.r2) / square(at.centre.z);
    const Vector velocity = body.v_cam + cross(body.omega_cam, at.centre - body.t_cam);
    const double vx = (velocity.x - at.x * velocity.z) / at.centre.z;
    const double vy = (velocity.y - at.y * velocity.z) / at.centre.z;
    const double sx = exposure.tau_sigma * vx, sy = exposure.tau_sigma * vy;  // in one standard deviation
    return {at,
            marker.disc.radius,
            {dot(gx * C, gx) + sx * sx, dot(gx * C, gy) + sx * sy, dot(gy * C, gy) + sy * sy},
            square(kSizeSigma) + depth_variance,
            vx,
            vy};
}

double major_axis(const DiscView& view, double radius, const Scale& scale) {
    const Shape s = outline(view.centre, view.normal, radius, scale);
    const double eigenvalue = (s.xx + s.yy + std::hypot(s.xx - s.yy, 2 * s.xy)) / 2;
    return 2 * std::sqrt(std::max(eigenvalue, kTinyPx2));
}

/// The cost of a pair; infinity outside the gates.
double cost(const ExpectedView& expected, const Detection& detection, const Detections& all, double focal) {
    const double u = detection.x - expected.at.x - detection.delay * expected.vx;
    const double v = detection.y - expected.at.y - detection.delay * expected.vy;
    const Symmetric &P = expected.covariance, &N = detection.noise;
    const double xx = P.xx + N.xx, xy = P.xy + N.xy, yy = P.yy + N.yy, det = xx * yy - xy * xy;
    const double d2 = (yy * u * u - 2 * xy * u * v + xx * v * v) / det;
    if (!(d2 < kGate)) return kInfinity;
    const size_t k = detection.index;
    const double predicted = major_axis(expected.at, expected.radius, scale_at(all.scale, k));
    const double log_ratio = std::log(all.major[k] / predicted);  // NaN where the size is unknown
    if (std::abs(log_ratio) > std::log(kSizeRatio)) return kInfinity;
    const double size_cost = std::isfinite(log_ratio) ? square(log_ratio) / expected.log_size_variance : 0;
    return d2 + size_cost + std::log(det * square(square(focal)) * expected.log_size_variance);
}

}  // namespace

Matrix position_covariance(const Vector& position, const Matrix& R, const double* P) {
    const Displacement by_pose = displacement_by_pose(position, R);
    return cross_covariance(P, by_pose, by_pose);
}

ExpectedMarker ExpectedMarker::of(int64_t body, int64_t code, const DiscOnBody& disc, const Matrix& R,
                                  const double* P) {
    const Displacement by_pose = displacement_by_pose(disc.position, R);
    const Displacement by_rates{minus_skew(R * disc.position), kOmega, kVelocity};
    const Matrix both = cross_covariance(P, by_pose, by_rates);
    return {body,
            code,
            disc,
            cross_covariance(P, by_pose, by_pose),
            both + transposed(both),
            cross_covariance(P, by_rates, by_rates)};
}

ExpectedMarkers::ExpectedMarkers(std::vector<ExpectedMarker> markers) : markers_(std::move(markers)) {
    for (size_t m = 0; m < markers_.size(); ++m) {
        const ExpectedMarker& marker = markers_[m];
        if (groups_.empty() || groups_.back().body != marker.body)
            groups_.push_back({marker.body, m, m, 0, 0, 0, 0});
        Group& group = groups_.back();
        group.last = m + 1;
        group.radius = std::max(group.radius, norm(marker.disc.position) + marker.disc.radius);
        group.at = std::max(group.at, trace(marker.at));
        group.rate = std::max(group.rate, std::abs(trace(marker.rate)));
        group.drift = std::max(group.drift, trace(marker.drift));
    }
}

std::vector<Candidate> find_candidates(const FramePoses& poses, const ExpectedMarkers& markers,
                                       const Detections& detections, const double* focal) {
    std::vector<Candidate> found;
    size_t first = 0, last = 0;
    for (size_t f = 0; f < poses.exposures().size(); ++f, first = last) {
        const Exposure& exposure = poses.exposures()[f];
        while (last < detections.size() && size_t(detections.frame[last]) == f) ++last;
        const FrameDetections of_frame(detections, first, last);
        for (const ExpectedMarkers::Group& group : markers.groups()) {
            if (of_frame.excludes(group, poses.bodies()[group.body], exposure)) continue;
            for (size_t m = group.first; m < group.last; ++m) {
                const ExpectedView expected = expect(markers.all()[m], poses.at(f, group.body), exposure);
                if (!(expected.at.facing() > kGrazing) || !std::isfinite(expected.at.x)) continue;
                of_frame.visit_near(expected, [&](const Detection& d) {
                    const double code = detections.code[d.index];
                    if (code >= 0 && code != double(markers.all()[m].code)) return;
                    const double value = cost(expected, d, detections, focal[f]);
                    if (std::isfinite(value)) found.push_back({int64_t(m), d.index, value});
                });
            }
        }
    }
    return found;
}

}  // namespace roundel::fusion
