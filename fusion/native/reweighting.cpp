// SPDX-License-Identifier: BSD-3-Clause
#include "reweighting.hpp"

#include <algorithm>
#include <numbers>
#include <numeric>
#include <optional>
#include <span>
#include <stdexcept>

#include "numeric/cholesky.hpp"
#include "numeric/simd.hpp"

namespace roundel::fusion {
namespace {

constexpr double kSingular = 1e-12;  // of a pivot to its element before
constexpr int kMaxReweightings = 4;  // for one linearization; one is usual
constexpr double kConverged = 0.1;   // changes of weights below this are not applied

/// The equations of one body with their weights, and the sums of its prior and its equations.
struct BodySums {
    std::vector<Equations> equations;
    std::vector<double> weights;
    ErrorMatrix H;  // the lower triangle only until the sums are complete
    ErrorVector g;
};

/// Adds to the rows `first` to `first + 3` of the lower triangle.
template <int first>
inline void add_strip(const double* a, const double* b, double weight, ErrorMatrix& H) {
    for (int i = first; i < first + 4; ++i) {
        const double by_a = weight * a[i], by_b = weight * b[i];
        for (int j = 0; j < first + 4; ++j) H[i][j] += by_a * a[j] + by_b * b[j];
    }
}

void add(BodySums& sums) { add(sums.equations, sums.weights, sums.H, sums.g); }

ErrorVector solve(const ErrorMatrix& H, const ErrorVector& g) {
    const Cholesky<kErrors> factor(H);
    return factor.positive() ? factor.solve(g) : ErrorVector{};
}

double residual(const double* row, const double* step) {
    double lanes[4] = {};
    for (int i = 0; i < kErrors; i += 4)
        for (int k = 0; k < 4; ++k) lanes[k] += row[i + k] * step[i + k];
    return row[kErrors] - ((lanes[0] + lanes[1]) + (lanes[2] + lanes[3]));
}

/// Computes the weights at a step; returns their largest change.
double reconsider(const BodySums& sums, const ErrorVector& step, std::vector<double>& weights) {
    double change = 0;
    for (size_t k = 0; k < sums.equations.size(); ++k) {
        const auto& A = sums.equations[k].A;
        const double x = residual(A[0], step.data()), y = residual(A[1], step.data());
        weights[k] = 1 / (kNominalWeight * (1 + (x * x + y * y) / (kCauchy * kCauchy)));
        change = std::max(change, std::abs(weights[k] - sums.weights[k]));
    }
    return change;
}

/// Reweighs the equations of one body until they converge; see `reweigh`.
void reweigh_body(BodySums& sums) {
    const ErrorMatrix H = sums.H;
    const ErrorVector g = sums.g;
    std::vector<double> weights(sums.weights.size());
    add(sums);
    for (int round = 0; round < kMaxReweightings; ++round) {
        const double change = reconsider(sums, solve(sums.H, sums.g), weights);
        if (round > 0 && change < kConverged) break;  // the next linearization continues, if there is one
        std::swap(sums.weights, weights);
        sums.H = H;
        sums.g = g;
        add(sums);
    }
    for (int i = 0; i < kErrors; ++i)
        for (int j = 0; j < i; ++j) sums.H[j][i] = sums.H[i][j];
}

}  // namespace

ROUNDEL_CLONES void add(const std::vector<Equations>& equations, const std::vector<double>& weights,
                        ErrorMatrix& H, ErrorVector& g) {
    for (size_t k = 0; k < equations.size(); ++k) {
        const Equations rows = equations[k];  // a copy, which cannot alias the sums
        const double *a = rows.A[0], *b = rows.A[1], weight = weights[k];
        add_strip<0>(a, b, weight, H);
        add_strip<4>(a, b, weight, H);
        add_strip<8>(a, b, weight, H);
        for (int i = 0; i < kErrors; ++i) g[i] += weight * a[i] * a[kErrors] + weight * b[i] * b[kErrors];
    }
}

ByBody::ByBody(const EquationSystem& system) : first(system.n_bodies + 1), indices(system.n_equations) {
    for (size_t k = 0; k < system.n_equations; ++k) ++first[system.body[k] + 1];
    std::partial_sum(first.begin(), first.end(), first.begin());
    std::vector<size_t> next = first;
    for (size_t k = 0; k < system.n_equations; ++k) indices[next[system.body[k]]++] = k;
}

void reweigh(const EquationSystem& system, ErrorMatrix* H, ErrorVector* g, double* weights) {
    BodySums sums;
    const ByBody of(system);
    for (size_t b = 0; b < system.n_bodies; ++b) {
        const std::span indices(of.indices.data() + of.first[b], of.first[b + 1] - of.first[b]);
        sums.equations.clear();
        sums.weights.clear();
        for (const size_t k : indices) {
            sums.equations.push_back(system.equations[k]);
            sums.weights.push_back(weights[k]);
        }
        sums.H = *H;
        sums.g = *g;
        reweigh_body(sums);
        *H++ = sums.H;
        *g++ = sums.g;
        for (size_t k = 0; k < indices.size(); ++k) weights[indices[k]] = sums.weights[k];
    }
}

void residuals(const EquationSystem& system, const double* steps, double* to) {
    for (size_t k = 0; k < system.n_equations; ++k)
        for (int a = 0; a < 2; ++a)
            to[a * system.n_equations + k] =
                residual(system.equations[k].A[a], steps + kErrors * system.body[k]);
}

namespace {

/// The equations of an assignment with more noise: with L L^T its covariance, and L' L'^T that with the
/// noise, L'^-1 L times those whitened by L^-1.
struct NoisyEquations {
    ErrorVector A[2];
    double nu[2], log_area;

    NoisyEquations(const Evidence& evidence, size_t k, double added_px2) {
        const CovarianceFactor L(evidence.cov, k), noisy(evidence.cov, k, added_px2);
        log_area = std::log(noisy.a * noisy.c);
        const auto whiten = [&](double x, double y, double& u, double& v) {
            u = L.a / noisy.a * x;
            v = (L.b * x + L.c * y - noisy.b * u) / noisy.c;
        };
        const auto& [u, v] = evidence.system.equations[k].A;
        for (int i = 0; i < kErrors; ++i) whiten(u[i], v[i], A[0][i], A[1][i]);
        whiten(u[kErrors], v[kErrors], nu[0], nu[1]);
    }
};

/// The log-likelihood of the uncertain assignments `rows` given the certain ones and the prediction, minus
/// that as any roundels of their images.
double log_ratio(const Evidence& evidence, const std::vector<size_t>& certain,
                 const std::vector<size_t>& rows, double added_px2, const ErrorMatrix& information) {
    // With the information L = P^-1 + A^T A and b = A^T nu of any assignments, det(A P A^T + I) = det P det
    // L, and nu^T (A P A^T + I)^-1 nu = nu^T nu - b^T L^-1 b.
    ErrorMatrix L = information;
    ErrorVector b{};
    const auto add = [&](const NoisyEquations& equations) {
        for (int a = 0; a < 2; ++a)
            for (int i = 0; i < kErrors; ++i) {
                b[i] += equations.A[a][i] * equations.nu[a];
                for (int j = 0; j <= i; ++j) L[i][j] += equations.A[a][i] * equations.A[a][j];
            }
    };
    const auto explained = [&] {
        const Cholesky<kErrors> factor(L);
        const ErrorVector z = factor.halfway(b);
        return std::inner_product(z.begin(), z.end(), z.begin(), 0.0) / 2 - factor.log_determinant() / 2;
    };
    for (const size_t k : certain) add(NoisyEquations(evidence, k, added_px2));
    double ratio = -explained();
    for (const size_t k : rows) {
        const NoisyEquations equations(evidence, k, added_px2);
        add(equations);
        const double x = equations.nu[0], y = equations.nu[1];
        ratio -= (x * x + y * y) / 2 + std::log(2 * std::numbers::pi);
        ratio -= equations.log_area + evidence.log_density[k];
    }
    return ratio + explained();
}

}  // namespace

void accept(const Evidence& evidence, const Doubts& doubts, const ErrorMatrix* information, bool* certain) {
    const ByBody of(evidence.system);
    std::vector<size_t> accepted;
    for (size_t d = 0; d < doubts.n; ++d) {
        const int64_t body = doubts.body[d], camera = doubts.camera[d];
        std::vector<size_t> beside, rows;
        for (size_t at = of.first[body]; at < of.first[body + 1]; ++at) {
            const size_t k = of.indices[at];
            if (certain[k])
                beside.push_back(k);
            else if (camera < 0 || evidence.camera[k] == camera)
                rows.push_back(k);
        }
        const double ratio = log_ratio(evidence, beside, rows, doubts.added_px2[d], information[body]);
        if (doubts.prior[d] + ratio > 0) accepted.insert(accepted.end(), rows.begin(), rows.end());
        if (d + 1 < doubts.n && doubts.turn[d + 1] == doubts.turn[d]) continue;
        for (const size_t k : accepted) certain[k] = true;
        accepted.clear();
    }
}

ROUNDEL_CLONES std::optional<ErrorMatrix> inverse_if_positive(const ErrorMatrix& H) {
    ErrorMatrix A = H;
    for (int k = 0; k < kErrors; ++k) {
        const double pivot = A[k][k];
        if (!(pivot > kSingular * H[k][k])) return std::nullopt;
        const double per_root = 1 / std::sqrt(pivot);
        ErrorVector scaled = A[k];
        for (double& x : scaled) x *= per_root;
        for (int i = 0; i < kErrors; ++i)
            for (int j = 0; j < kErrors; ++j) A[i][j] -= scaled[i] * scaled[j];
        for (int j = 0; j < kErrors; ++j) A[k][j] = A[j][k] = scaled[j] * per_root;
        A[k][k] = -1 / pivot;
    }
    for (ErrorVector& row : A)
        for (double& x : row) x = -x;
    return A;
}

ErrorMatrix inverse(const ErrorMatrix& H) {
    if (const auto inverted = inverse_if_positive(H)) return *inverted;
    throw std::runtime_error("the information matrix of a robot is not positive definite");
}

}  // namespace roundel::fusion
