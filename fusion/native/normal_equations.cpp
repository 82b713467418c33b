// SPDX-License-Identifier: BSD-3-Clause
#include "normal_equations.hpp"

#include <algorithm>
#include <stdexcept>

#include "../../camera_node/native/numeric/cholesky.hpp"
#include "../../camera_node/native/numeric/simd.hpp"

namespace roundel::fusion {
namespace {

constexpr int kReweightings = 4;  // by one linearisation at the most; two mostly
constexpr double kSettled = 0.1;  // change of a weight that ends them

/// One body's rows and their weights, and the sums of its prior and these.
struct Sums {
    std::vector<Rows> rows;
    std::vector<double> weights;
    Square H;  // its lower triangle, until they are done
    Step g;
};

/// Rows `first` to `first + 3` of the sums, as far as the lower triangle reaches.
template <int first>
inline void add_strip(const double* a, const double* b, double weight, Square& H) {
    for (int i = first; i < first + 4; ++i) {
        const double by_a = weight * a[i], by_b = weight * b[i];
        for (int j = 0; j < first + 4; ++j) H[i][j] += by_a * a[j] + by_b * b[j];
    }
}

ROUNDEL_CLONES void add(Sums& sums) {
    for (size_t k = 0; k < sums.rows.size(); ++k) {
        const Rows rows = sums.rows[k];  // a copy, which the sums can't be part of
        const double *a = rows.A[0], *b = rows.A[1], weight = sums.weights[k];
        add_strip<0>(a, b, weight, sums.H);
        add_strip<4>(a, b, weight, sums.H);
        add_strip<8>(a, b, weight, sums.H);
        for (int i = 0; i < kErrors; ++i)
            sums.g[i] += weight * a[i] * a[kErrors] + weight * b[i] * b[kErrors];
    }
}

Step solve(const Square& H, const Step& g) {
    const Cholesky<kErrors> factor(H);
    return factor.positive() ? factor.solve(g) : Step{};
}

double left(const double* row, const double* step) {
    double lanes[4] = {};
    for (int i = 0; i < kErrors; i += 4)
        for (int k = 0; k < 4; ++k) lanes[k] += row[i + k] * step[i + k];
    return row[kErrors] - ((lanes[0] + lanes[1]) + (lanes[2] + lanes[3]));
}

/// The largest change of a weight.
double weigh(Sums& sums, const Step& step) {
    double change = 0;
    for (size_t k = 0; k < sums.rows.size(); ++k) {
        const double x = left(sums.rows[k].A[0], step.data()), y = left(sums.rows[k].A[1], step.data());
        const double weight = 1 / (kNominalWeight * (1 + (x * x + y * y) / (kCauchy * kCauchy)));
        change = std::max(change, std::abs(weight - sums.weights[k]));
        sums.weights[k] = weight;
    }
    return change;
}

/// See `reweigh`; of one body.
void settle(Sums& sums) {
    const Square H = sums.H;
    const Step g = sums.g;
    double change = 1;
    for (int round = 0; round <= kReweightings; ++round) {
        sums.H = H, sums.g = g;
        add(sums);
        if (round == kReweightings || change < kSettled) break;
        change = weigh(sums, solve(sums.H, sums.g));
    }
    for (int i = 0; i < kErrors; ++i)
        for (int j = 0; j < i; ++j) sums.H[j][i] = sums.H[i][j];
}

/// The rows of each body.
std::vector<std::vector<size_t>> sorted(const System& system) {
    std::vector<std::vector<size_t>> of_body(system.n_bodies);
    for (size_t k = 0; k < system.n_rows; ++k) of_body[system.body[k]].push_back(k);
    return of_body;
}

}  // namespace

void reweigh(const System& system, Square* H, Step* g, double* weights) {
    Sums sums;
    for (const auto& mine : sorted(system)) {
        sums.rows.clear(), sums.weights.clear();
        for (const size_t k : mine) sums.rows.push_back(system.rows[k]), sums.weights.push_back(weights[k]);
        sums.H = *H, sums.g = *g;
        settle(sums);
        *H++ = sums.H, *g++ = sums.g;
        for (size_t k = 0; k < mine.size(); ++k) weights[mine[k]] = sums.weights[k];
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
