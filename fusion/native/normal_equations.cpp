// SPDX-License-Identifier: BSD-3-Clause
#include "normal_equations.hpp"

#include <algorithm>
#include <stdexcept>

#include "../../camera_node/native/numeric/cholesky.hpp"
#include "../../camera_node/native/numeric/simd.hpp"

namespace roundel::fusion {
namespace {

constexpr int kMaxReweightings = 4;  // for one linearization; two are usual
constexpr double kConverged = 0.1;   // largest change of a weight at convergence

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

ROUNDEL_CLONES void add(BodySums& sums) {
    for (size_t k = 0; k < sums.equations.size(); ++k) {
        const Equations equations = sums.equations[k];  // a copy, which cannot alias the sums
        const double *a = equations.A[0], *b = equations.A[1], weight = sums.weights[k];
        add_strip<0>(a, b, weight, sums.H);
        add_strip<4>(a, b, weight, sums.H);
        add_strip<8>(a, b, weight, sums.H);
        for (int i = 0; i < kErrors; ++i)
            sums.g[i] += weight * a[i] * a[kErrors] + weight * b[i] * b[kErrors];
    }
}

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

/// Computes the weights at a step; returns the largest change.
double update_weights(BodySums& sums, const ErrorVector& step) {
    double change = 0;
    for (size_t k = 0; k < sums.equations.size(); ++k) {
        const auto& A = sums.equations[k].A;
        const double x = residual(A[0], step.data()), y = residual(A[1], step.data());
        const double weight = 1 / (kNominalWeight * (1 + (x * x + y * y) / (kCauchy * kCauchy)));
        change = std::max(change, std::abs(weight - sums.weights[k]));
        sums.weights[k] = weight;
    }
    return change;
}

/// Reweighs the equations of one body until they converge; see `reweigh`.
void reweigh_body(BodySums& sums) {
    const ErrorMatrix H = sums.H;
    const ErrorVector g = sums.g;
    double change = 1;
    for (int round = 0; round <= kMaxReweightings; ++round) {
        sums.H = H, sums.g = g;
        add(sums);
        if (round == kMaxReweightings || change < kConverged) break;
        change = update_weights(sums, solve(sums.H, sums.g));
    }
    for (int i = 0; i < kErrors; ++i)
        for (int j = 0; j < i; ++j) sums.H[j][i] = sums.H[i][j];
}

std::vector<std::vector<size_t>> indices_by_body(const EquationSystem& system) {
    std::vector<std::vector<size_t>> of_body(system.n_bodies);
    for (size_t k = 0; k < system.n_equations; ++k) of_body[system.body[k]].push_back(k);
    return of_body;
}

}  // namespace

void reweigh(const EquationSystem& system, ErrorMatrix* H, ErrorVector* g, double* weights) {
    BodySums sums;
    for (const auto& indices : indices_by_body(system)) {
        sums.equations.clear(), sums.weights.clear();
        for (const size_t k : indices)
            sums.equations.push_back(system.equations[k]), sums.weights.push_back(weights[k]);
        sums.H = *H, sums.g = *g;
        reweigh_body(sums);
        *H++ = sums.H, *g++ = sums.g;
        for (size_t k = 0; k < indices.size(); ++k) weights[indices[k]] = sums.weights[k];
    }
}

void residuals(const EquationSystem& system, const double* steps, double* to) {
    for (size_t k = 0; k < system.n_equations; ++k)
        for (int a = 0; a < 2; ++a)
            to[a * system.n_equations + k] =
                residual(system.equations[k].A[a], steps + kErrors * system.body[k]);
}

ErrorMatrix inverse(const ErrorMatrix& H) {
    const Cholesky<kErrors> factor(H);
    if (!factor.positive())
        throw std::runtime_error("the information matrix of a robot is not positive definite");
    return factor.inverse_tail<kErrors>();
}

}  // namespace roundel::fusion
