// SPDX-License-Identifier: BSD-3-Clause
#include "lens/known_lens.hpp"

#include <cmath>
#include <limits>
#include <optional>

#include "lens/disc_view.hpp"

namespace roundel {

namespace {

constexpr int kSteps = 8;            // of Gauss-Newton; the start is a few hundredths of a radian away
constexpr double kConverged = 0.03;  // standard deviations
constexpr double kMaxStep = 0.2;     // radians, and of the distance
constexpr double kScatter = 1.5;     // squared errors of small roundels' offsets over their covariance
constexpr double kContradiction =
    18;  // chi-square of two degrees of freedom: 3 standard deviations, scattered

constexpr int kMeasured = DiscMeasurement::kCount, kUnknowns = DiscView::kUnknowns;
using Matrix7 = std::array<Vector<kMeasured>, kMeasured>;
using Step = Vector<kUnknowns>;

/// The measurement in the normalised image plane, and the derivative T of its numbers by those in pixels.
struct NormalisedMeasurement {
    Vector<kMeasured> values;  // centre, S = A A^T as xx, xy, yy, and the disc's centre
    Matrix7 T;
};

/// The symmetric root A of the ellipse's shape.
Symmetric root_of(const Ellipse& e) { return from_eigenvalues(e.major / 2, e.minor / 2, e.angle); }

/// The derivative of S = J A A J^T by one of the numbers of A, dA.
Symmetric shape_derivative(const LinearMap& J, const Symmetric& A, const Symmetric& dA) {
    const double xx = 2 * (dA.xx * A.xx + dA.xy * A.xy), yy = 2 * (dA.xy * A.xy + dA.yy * A.yy);
    const double xy = dA.xx * A.xy + dA.xy * A.yy + A.xx * dA.xy + A.xy * dA.yy;
    return mapped(J, {xx, xy, yy});
}

/// The derivative of the normalised measurement, with the lens approximated as linear over the roundel.
Matrix7 derivative_of(const LinearMap& J, const Symmetric& A) {
    Matrix7 T{};
    for (const auto& [row, column] : {std::pair(0, 0), std::pair(5, 0), std::pair(5, 5)}) {
        T[row][column] = J.xx;
        T[row][column + 1] = J.xy;
        T[row + 1][column] = J.yx;
        T[row + 1][column + 1] = J.yy;
    }
    constexpr Symmetric kUnit[] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
    for (int k = 0; k < 3; ++k) {
        const Symmetric dS = shape_derivative(J, A, kUnit[k]);
        T[2][2 + k] = dS.xx;
        T[3][2 + k] = dS.xy;
        T[4][2 + k] = dS.yy;
    }
    return T;
}

std::optional<NormalisedMeasurement> normalise(const DiscMeasurement& m, const Lens& lens) {
    const Point centre{m.outer.x, m.outer.y};
    const auto xy = lens.normalise(centre);
    if (!xy) return std::nullopt;
    const LinearMap J = lens.derivative(*xy).inverse();
    const Symmetric A = root_of(m.outer);
    const auto image = ellipse_through(lens, centre, A, *xy, J);
    const auto disc = lens.normalise_near({centre.x + m.offset.x, centre.y + m.offset.y}, *xy, J);
    if (!image || !disc) return std::nullopt;
    const Symmetric& S = image->shape;
    return NormalisedMeasurement{{image->x, image->y, S.xx, S.xy, S.yy, disc->x, disc->y},
                                 derivative_of(J, A)};
}

/// A least squares estimate of the disc's pose: its remaining chi-square, whitened residuals and derivatives.
struct Estimate {
    double chi2;
    Vector<kMeasured> residual;
    std::array<Vector<kMeasured>, kUnknowns> columns;
    std::array<Step, kUnknowns> information;
};

class PoseEstimator {
  public:
    /// `covariance` of the measurement, factorized.
    PoseEstimator(const Vector<kMeasured>& measured, const Cholesky<kMeasured>& covariance)
        : measured_(measured), covariance_(covariance) {}

    std::optional<Estimate> estimate(DiscView disc) const {
        for (int k = 0; k < kSteps; ++k) {
            const Estimate here = linearize(disc);
            Step gradient{};
            for (int i = 0; i < kUnknowns; ++i)
                for (int j = 0; j < kMeasured; ++j) gradient[i] += here.columns[i][j] * here.residual[j];
            const Cholesky<kUnknowns> factor(here.information);
            if (!factor.positive()) return std::nullopt;
            Step step = factor.solve(gradient);
            double moved = 0, most = 0;
            for (int i = 0; i < kUnknowns; ++i) {
                moved += step[i] * gradient[i];
                most = std::max(most, std::abs(step[i]));
            }
            for (double& value : step) value *= std::min(1.0, kMaxStep / most);
            disc.move(step);
            if (!disc.is_visible()) return std::nullopt;
            if (moved < kConverged * kConverged) break;
        }
        return linearize(disc);
    }

  private:
    Estimate linearize(const DiscView& disc) const {
        const auto [predicted, derivatives] = disc.predict();
        Estimate at{};
        Vector<kMeasured> off;
        for (int j = 0; j < kMeasured; ++j) off[j] = measured_[j] - predicted[j];
        at.residual = covariance_.halfway(off);
        for (const double r : at.residual) at.chi2 += r * r;
        for (int i = 0; i < kUnknowns; ++i) at.columns[i] = covariance_.halfway(derivatives[i]);
        for (int i = 0; i < kUnknowns; ++i)
            for (int k = 0; k <= i; ++k)
                for (int j = 0; j < kMeasured; ++j)
                    at.information[i][k] += at.columns[i][j] * at.columns[k][j];
        return at;
    }

    const Vector<kMeasured>& measured_;
    const Cholesky<kMeasured>& covariance_;
};

Matrix7 product(const Matrix7& a, const Matrix7& b) {
    Matrix7 c{};
    for (int i = 0; i < kMeasured; ++i)
        for (int k = 0; k < kMeasured; ++k)
            for (int j = 0; j < kMeasured; ++j) c[i][j] += a[i][k] * b[k][j];
    return c;
}

Matrix7 transpose(const Matrix7& a) {
    Matrix7 b;
    for (int i = 0; i < kMeasured; ++i)
        for (int j = 0; j < kMeasured; ++j) b[i][j] = a[j][i];
    return b;
}

/// What a pose makes of the measurement: the change of its numbers, and the covariance of the centre.
struct Change {
    Vector<kMeasured> by{};
    Symmetric covariance{};
};

/// The conditional mean and covariance of the true picture, whose prior is the measurement with covariance
/// Sigma, given the pose's picture with the lens's covariance:
///   change = -W^T r,  covariance = Sigma - W^T (1 - P) W,
/// with the whitened W = L^-1 T Sigma, residuals r, and the projection P on the derivatives.
Change condition(const Estimate& pose, const std::array<Vector<kMeasured>, kMeasured>& whitened,
                 const Matrix7& covariance) {
    const Cholesky<kUnknowns> factor(pose.information);
    Change change;
    std::array<Step, 2> projected{};
    for (int a = 0; a < kMeasured; ++a)
        for (int j = 0; j < kMeasured; ++j) change.by[a] -= whitened[a][j] * pose.residual[j];
    for (int a = 0; a < 2; ++a) {
        for (int i = 0; i < kUnknowns; ++i)
            for (int j = 0; j < kMeasured; ++j) projected[a][i] += pose.columns[i][j] * whitened[a][j];
        projected[a] = factor.halfway(projected[a]);
    }
    const auto element = [&](int a, int b) {
        double value = covariance[a][b];
        for (int j = 0; j < kMeasured; ++j) value -= whitened[a][j] * whitened[b][j];
        for (int i = 0; i < kUnknowns; ++i) value += projected[a][i] * projected[b][i];
        return value;
    };
    change.covariance = {element(0, 0), element(0, 1), element(1, 1)};
    return change;
}

/// The first two moments of the changes by both poses, of the given probabilities.
Change mean_of(const std::array<Change, 2>& changes, const std::array<double, 2>& probability) {
    Change mean;
    for (int k = 0; k < 2; ++k)
        for (int i = 0; i < kMeasured; ++i) mean.by[i] += probability[k] * changes[k].by[i];
    for (int k = 0; k < 2; ++k) {
        const double x = changes[k].by[0] - mean.by[0], y = changes[k].by[1] - mean.by[1];
        const Symmetric& own = changes[k].covariance;
        mean.covariance.xx += probability[k] * (own.xx + x * x);
        mean.covariance.xy += probability[k] * (own.xy + x * y);
        mean.covariance.yy += probability[k] * (own.yy + y * y);
    }
    return mean;
}

Ellipse moved(const Ellipse& outer, const Vector<kMeasured>& by) {
    const Symmetric A = root_of(outer);
    const Eigen axes = eigen({A.xx + by[2], A.xy + by[3], A.yy + by[4]});
    return {outer.x + by[0], outer.y + by[1], 2 * axes.first, 2 * axes.second, axes.angle};
}

}  // namespace

ConstrainedEllipse constrain_to_lens(const DiscMeasurement& measured, const Lens& lens, double lens_sigma) {
    const Matrix7& Sigma = measured.covariance;
    ConstrainedEllipse result{
        measured.outer, {Sigma[0][0], Sigma[0][1], Sigma[1][1]}, std::numeric_limits<double>::quiet_NaN()};
    const auto seen = normalise(measured, lens);
    if (!seen) return result;
    const Matrix7 projected = product(seen->T, Sigma);
    Matrix7 total = product(projected, transpose(seen->T));
    // The offset of a disc of radius r is r^2 sin t cos t in the normalised image plane.
    const double r2 = std::sqrt(seen->values[2] * seen->values[4] - seen->values[3] * seen->values[3]);
    for (int i = 5; i < kMeasured; ++i) total[i][i] += (lens_sigma * r2) * (lens_sigma * r2);
    const Cholesky<kMeasured> factor(total);
    if (!factor.positive()) return result;
    const PoseEstimator estimator(seen->values, factor);
    const auto [first, second] = DiscView::both_of(seen->values);
    const auto one = estimator.estimate(first), other = estimator.estimate(second);
    if (!one || !other) return result;
    result.chi2 = std::min(one->chi2, other->chi2);
    if (!(result.chi2 < kContradiction)) return result;
    const double odds = std::exp((one->chi2 - other->chi2) / (2 * kScatter)), p = 1 / (1 + odds);
    Matrix7 whitened = transpose(projected);
    for (auto& row : whitened) row = factor.halfway(row);
    const Change change =
        mean_of({condition(*one, whitened, Sigma), condition(*other, whitened, Sigma)}, {p, 1 - p});
    result.outer = moved(measured.outer, change.by);
    result.covariance = change.covariance;
    return result;
}

}  // namespace roundel
