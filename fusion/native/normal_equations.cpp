// SPDX-License-Identifier: BSD-3-Clause
#include "normal_equations.hpp"

#include <algorithm>
#include <stdexcept>

#include "../../camera_node/native/cholesky.hpp"
#include "../../camera_node/native/simd.hpp"

namespace roundel::fusion {
namespace {

constexpr int kReweightings = 4;  // by one linearisation at the most; two mostly
constexpr double kSettled = 0.1;  // change of a weight that ends them

ROUNDEL_CLONES void add(const System& system, const double* weights, Square* H, Step* g) {
    for (size_t k = 0; k < system.n_rows; ++k) {
        Square& information = H[system.body[k]];
        Step& right = g[system.body[k]];
        const Rows rows = system.rows[k];  // a copy, which the sums can't be part of
        const double *a = rows.A[0], *b = rows.A[1], weight = weights[k];
        for (int i = 0; i < kErrors; ++i) {
            const double by_a = weight * a[i], by_b = weight * b[i];
            for (int j = 0; j < kErrors; ++j) information[i][j] += by_a * a[j] + by_b * b[j];
            right[i] += by_a * a[kErrors] + by_b * b[kErrors];
        }
    }
}

Step solve(const Square& H, const Step& g) {
    const Cholesky<kErrors> factor(H);
    return factor.positive() ? factor.solve(g) : Step{};
}

double left(const double* row, const double* step) {
    double rest = row[kErrors];
    for (int i = 0; i < kErrors; ++i) rest -= row[i] * step[i];
    return rest;
}

/// The largest change of a weight.
double weigh(const System& system, const std::vector<Step>& steps, double* weights) {
    double change = 0;
    for (size_t k = 0; k < system.n_rows; ++k) {
        const double* step = steps[system.body[k]].data();
        const double x = left(system.rows[k].A[0], step), y = left(system.rows[k].A[1], step);
        const double weight = 1 / (kNominalWeight * (1 + (x * x + y * y) / (kCauchy * kCauchy)));
        change = std::max(change, std::abs(weight - weights[k]));
        weights[k] = weight;
    }
    return change;
}

}  // namespace

void reweigh(const System& system, Square* H, Step* g, double* weights) {
    const size_t n = system.n_bodies;
    const std::vector<Square> prior_H(H, H + n);
    const std::vector<Step> prior_g(g, g + n);
    std::vector<Step> steps(n);
    double change = 1;
    for (int round = 0; round <= kReweightings; ++round) {
        std::copy(prior_H.begin(), prior_H.end(), H);
        std::copy(prior_g.begin(), prior_g.end(), g);
        add(system, weights, H, g);
        if (round == kReweightings || change < kSettled) break;
        std::transform(H, H + n, g, steps.begin(), solve);
        change = weigh(system, steps, weights);
    }
}

void remain(const System& system, const double* steps, double* to) {
    for (size_t k = 0; k < system.n_rows; ++k)
        for (int a = 0; a < 2; ++a)
            to[a * system.n_rows + k] = left(system.rows[k].A[a], steps + kErrors * system.body[k]);
}

Square inverse(const Square& H) {
    const Cholesky<kErrors> factor(H);
    if (!factor.positive()) throw std::runtime_error("a robot's information is not positive definite");
    return factor.inverse_tail<kErrors>();
}

}  // namespace roundel::fusion
