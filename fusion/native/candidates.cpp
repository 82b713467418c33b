// SPDX-License-Identifier: BSD-3-Clause
#include "candidates.hpp"

#include <algorithm>

namespace roundel::fusion {
namespace {

constexpr double kGate = 13.8;       // chi-square with 2 degrees: one detection in a thousand is lost to it
constexpr double kSlackPx = 0.7;     // what a calibration may be off, added to the gate
constexpr double kSizeRatio = 1.35;  // between the measured and the predicted major axis, at the most
constexpr double kSizeSigma = 0.05;  // of the logarithm of that, where the distance is known
constexpr double kGrazing = 0.1;     // cosine of sight and normal under which a print is not read
constexpr double kInfinity = std::numeric_limits<double>::infinity();
constexpr double kTinyPx2 = 1e-6;  // squared half axis: what is nearer than its own radius has no outline

/// A symmetric 2 x 2 covariance in the undistorted plane.
struct Spread {
    double xx, xy, yy;
};

struct Placement {  // a detection, sorted by x
    double x, y;
    Spread noise;
    int64_t detection;
};

Matrix block(const double* P, int row, int column) {
    const auto at = [&](int i) {
        const double* p = P + 12 * (row + i) + column;
        return Vector{p[0], p[1], p[2]};
    };
    return {at(0), at(1), at(2)};
}

Matrix transposed(const Matrix& A) { return {A.column0(), A.column1(), A.column2()}; }

/// -[w]x: how w x e moves by e, negated.
Matrix minus_skew(const Vector& w) { return {{0, w.z, -w.y}, {-w.z, 0, w.x}, {w.y, -w.x, 0}}; }

/// The covariance of A e_a + e_b and B e_c + e_d, where e are parts of the state's error.
Matrix covary(const double* P, const Matrix& A, int a, int b, const Matrix& B, int c, int d) {
    const Matrix B_T = transposed(B);
    return (A * block(P, a, c) + block(P, b, c)) * B_T + A * block(P, a, d) + block(P, b, d);
}

/// A detection's noise with the calibration's, by the inverse of its scale.
Spread noise_of(const Scale& s, double uu, double uv, double vv) {
    const double p = uu + kSlackPx * kSlackPx, q = uv, r = vv + kSlackPx * kSlackPx;
    const double det = s.ux * s.vy - s.uy * s.vx, per = 1 / (det * det);
    return {per * (s.vy * s.vy * p - 2 * s.vy * s.uy * q + s.uy * s.uy * r),
            per * ((s.ux * s.vy + s.uy * s.vx) * q - s.vx * s.vy * p - s.ux * s.uy * r),
            per * (s.vx * s.vx * p - 2 * s.vx * s.ux * q + s.ux * s.ux * r)};
}

/// One frame's detections, which a marker's gate is looked up in.
class Field {
  public:
    Field(const Detections& seen, size_t first, size_t last) {
        for (size_t k = first; k < last; ++k) {
            const Spread noise =
                noise_of(Scale::of(seen.scale, k), seen.cov.at(0, k), seen.cov.at(1, k), seen.cov.at(3, k));
            if (!std::isfinite(seen.xy.at(0, k) + noise.xx + noise.yy)) continue;
            sorted_.push_back({seen.xy.at(0, k), seen.xy.at(1, k), noise, int64_t(k)});
            worst_x_ = std::max(worst_x_, noise.xx);
            worst_y_ = std::max(worst_y_, noise.yy);
        }
        std::sort(sorted_.begin(), sorted_.end(), [](const auto& a, const auto& b) { return a.x < b.x; });
    }
    template <class Visit>
    void visit_near(double x, double y, const Spread& spread, const Visit& visit) const {
        const double reach_x = std::sqrt(kGate * (spread.xx + worst_x_));
        const double reach_y = std::sqrt(kGate * (spread.yy + worst_y_));
        auto at = std::lower_bound(sorted_.begin(), sorted_.end(), x - reach_x,
                                   [](const Placement& p, double value) { return p.x < value; });
        for (; at != sorted_.end() && at->x < x + reach_x; ++at)
            if (std::abs(at->y - y) < reach_y) visit(*at);
    }

  private:
    std::vector<Placement> sorted_;
    double worst_x_ = 0, worst_y_ = 0;
};

double square(double x) { return x * x; }

/// A marker as it should look in a frame, and how well that is known; the size by its logarithm.
struct Expectation {
    View at;
    double radius;
    Spread spread;
    double size_variance;
};

Expectation expect(const ExpectedMarker& marker, const Placed& body, const Exposure& exposure) {
    const View at = view(body, marker.marker, marker.radius);
    const Matrix C = marker.covariance(exposure.tau), &R = exposure.R_cam_world;
    const Vector gx = (1 / at.centre.z) * (R.r0 - at.x * R.r2), gy = (1 / at.centre.z) * (R.r1 - at.y * R.r2);
    const double depth_variance = dot(R.r2 * C, R.r2) / square(at.centre.z);
    return {at,
            marker.radius,
            {dot(gx * C, gx), dot(gx * C, gy), dot(gy * C, gy)},
            square(kSizeSigma) + depth_variance};
}

double major_of(const View& marker, double radius, const Scale& scale) {
    const Shape s = outline(marker.centre, marker.normal, radius, scale);
    const double largest = (s.xx + s.yy + std::hypot(s.xx - s.yy, 2 * s.xy)) / 2;  // eigenvalue
    return 2 * std::sqrt(std::max(largest, kTinyPx2));
}

/// What a pair costs, infinity beyond the gates.
double cost(const Expectation& expected, const Placement& seen, double major, const Scale& scale,
            double focal) {
    const double u = seen.x - expected.at.x, v = seen.y - expected.at.y;
    const double xx = expected.spread.xx + seen.noise.xx, xy = expected.spread.xy + seen.noise.xy,
                 yy = expected.spread.yy + seen.noise.yy, det = xx * yy - xy * xy;
    const double d2 = (yy * u * u - 2 * xy * u * v + xx * v * v) / det;
    if (!(d2 < kGate)) return kInfinity;
    const double off = std::log(major / major_of(expected.at, expected.radius, scale));
    if (std::abs(off) > std::log(kSizeRatio)) return kInfinity;
    const double unlike = std::isfinite(off) ? square(off) / expected.size_variance : 0;  // NaN: unknown
    return d2 + unlike + std::log(det * square(square(focal)) * expected.size_variance);
}

}  // namespace

ExpectedMarker ExpectedMarker::of(int64_t body, const Vector& marker, double radius, const Matrix& R,
                                  const double* P) {
    constexpr int kTheta = 0, kPosition = 3, kOmega = 6, kVelocity = 9;
    const Matrix by_turn = R * minus_skew(marker), by_rate = minus_skew(R * marker);
    const Matrix both = covary(P, by_turn, kTheta, kPosition, by_rate, kOmega, kVelocity);
    return {body,
            marker,
            radius,
            covary(P, by_turn, kTheta, kPosition, by_turn, kTheta, kPosition),
            both + transposed(both),
            covary(P, by_rate, kOmega, kVelocity, by_rate, kOmega, kVelocity)};
}

std::vector<Candidate> find_candidates(const Poses& poses, const std::vector<ExpectedMarker>& markers,
                                       const Detections& seen, const double* focal) {
    std::vector<Candidate> found;
    size_t first = 0, last = 0;
    for (size_t f = 0; f < poses.exposures().size(); ++f, first = last) {
        while (last < seen.size() && size_t(seen.frame[last]) == f) ++last;
        const Field field(seen, first, last);
        for (size_t m = 0; m < markers.size(); ++m) {
            const Expectation expected =
                expect(markers[m], poses.at(f, markers[m].body), poses.exposures()[f]);
            if (!(expected.at.facing() > kGrazing) || !std::isfinite(expected.at.x)) continue;
            field.visit_near(expected.at.x, expected.at.y, expected.spread, [&](const Placement& p) {
                const int64_t k = p.detection;
                const double costs = cost(expected, p, seen.major[k], Scale::of(seen.scale, k), focal[f]);
                if (std::isfinite(costs)) found.push_back({int64_t(m), k, costs});
            });
        }
    }
    return found;
}

}  // namespace roundel::fusion
