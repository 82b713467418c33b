// SPDX-License-Identifier: BSD-3-Clause
#include "motion_models.hpp"

#include <algorithm>
#include <cmath>

#include "numeric/simd.hpp"

namespace roundel::fusion {
namespace {

/// Of a pivot to its element before: what rounding leaves of zero is less.
constexpr double kSingular = 1e-9;
/// Of the variance of a detection, the least share that is its own.
constexpr double kLeastOwn = 1e-3;

/// The observations of a body as independent errors z of unit variance, to which the errors of its state
/// contribute G^T delta: with H = A^T A and g = A^T b over the equations, H = G G^T and g = G z. Columns of G
/// are zero where H is singular.
struct ReducedObservations {
    ErrorMatrix G{};
    ErrorVector z{};
};

/// The equations with innovations in standard deviations of the detection's own noise, of whose variance the
/// share `of_rig` counts the errors of its camera.
Equations with_own_noise(Equations equations, double of_rig) {
    const double precision = 1 / std::sqrt(std::max(1 - of_rig, kLeastOwn));
    for (auto& row : equations.A) row[kErrors] *= precision;
    return equations;
}

/// Of the lower triangle of H.
ROUNDEL_CLONES ReducedObservations reduce(ErrorMatrix H, ErrorVector g) {
    ReducedObservations to;
    const ErrorMatrix whole = H;
    for (int j = 0; j < kErrors; ++j) {
        if (H[j][j] <= kSingular * whole[j][j]) continue;
        const double root = std::sqrt(H[j][j]);
        to.z[j] = g[j] / root;
        ErrorVector column{};
        for (int i = j; i < kErrors; ++i) to.G[i][j] = column[i] = H[i][j] / root;
        for (int i = j + 1; i < kErrors; ++i) {
            for (int k = 0; k < kErrors; ++k) H[i][k] -= column[i] * column[k];
            g[i] -= column[i] * to.z[j];
        }
    }
    return to;
}

/// G^T P G of a lower triangular G.
ROUNDEL_CLONES ErrorMatrix congruent(const ErrorMatrix& G, const ErrorMatrix& P) {
    ErrorMatrix half{}, whole{};
    for (int i = 0; i < kErrors; ++i)
        for (int k = 0; k < kErrors; ++k)
            for (int j = 0; j < kErrors; ++j) half[i][j] += P[i][k] * G[k][j];
    for (int j = 0; j < kErrors; ++j)
        for (int i = j; i < kErrors; ++i)
            for (int k = 0; k < kErrors; ++k) whole[j][k] += G[i][j] * half[i][k];
    return whole;
}

/// P + by Q.
ErrorMatrix sum(const ErrorMatrix& P, double by, const ErrorMatrix& Q) {
    ErrorMatrix to;
    for (int i = 0; i < kErrors; ++i)
        for (int j = 0; j < kErrors; ++j) to[i][j] = P[i][j] + by * Q[i][j];
    return to;
}

/// A number of each model; GCC and Clang compute them at once.
typedef double Models __attribute__((vector_size(8 * kModels)));

/// -2 ln of the densities of z, whose covariances are S + by T, less a constant: S + by T = L D L^T.
ROUNDEL_CLONES void costs_of(const ErrorVector& z, const ErrorMatrix& S, const ErrorMatrix& T,
                             const ModelNumbers& by, ModelNumbers& costs) {
    Models L[kErrors][kErrors], D[kErrors], y[kErrors], factor, squares{}, determinant = Models{} + 1.0;
    std::copy_n(by.data(), kModels, reinterpret_cast<double*>(&factor));
    for (int i = 0; i < kErrors; ++i) {
        D[i] = S[i][i] + factor * T[i][i];
        y[i] = Models{} + z[i];
        for (int j = 0; j < i; ++j) {
            Models scaled = S[i][j] + factor * T[i][j];  // L_ij D_j
            for (int k = 0; k < j; ++k) scaled -= L[i][k] * D[k] * L[j][k];
            L[i][j] = scaled / D[j];
            D[i] -= scaled * L[i][j];
            y[i] -= L[i][j] * y[j];
        }
        squares += y[i] * y[i] / D[i];
        determinant *= D[i];
    }
    for (int m = 0; m < kModels; ++m) costs[m] = std::log(determinant[m]) + squares[m];
}

/// Multiplies probabilities by likelihoods, given as costs.
void weigh(const ModelNumbers& costs, double* probabilities) {
    const double least = *std::min_element(costs.begin(), costs.end());
    double total = 0;
    for (int m = 0; m < kModels; ++m) total += probabilities[m] *= std::exp((least - costs[m]) / 2);
    for (int m = 0; m < kModels; ++m) probabilities[m] /= total;
}

}  // namespace

std::vector<size_t> weigh_motions(const PredictedBodies& predicted, const ModelNumbers& shares,
                                  double* probabilities, ErrorMatrix* P, ErrorMatrix* information) {
    const ByBody of(predicted.observed);
    std::vector<size_t> weighed;
    std::vector<Equations> equations;
    ModelNumbers less, costs;  // of the declared densities, all of which are in P
    for (int m = 0; m < kModels; ++m) less[m] = shares[m] - 1;
    for (size_t b = 0; b < predicted.observed.n_bodies; ++b) {
        const size_t *begin = of.indices.data() + of.first[b], *end = of.indices.data() + of.first[b + 1];
        const auto is_of_another = [&](size_t k) { return predicted.camera[k] != predicted.camera[*begin]; };
        if (std::none_of(begin, end, is_of_another)) continue;
        ErrorMatrix H{};
        ErrorVector g{};
        equations.clear();
        for (const size_t* k = begin; k < end; ++k)
            equations.push_back(with_own_noise(predicted.observed.equations[*k], predicted.rig_share[*k]));
        add(equations, std::vector(equations.size(), 1.0), H, g);
        const auto [G, z] = reduce(H, g);
        const ErrorMatrix noise = process_noise(predicted.bodies[b], predicted.intervals[b]);
        ErrorMatrix S = congruent(G, predicted.P[b]);
        for (int i = 0; i < kErrors; ++i) S[i][i] += 1;
        costs_of(z, S, congruent(G, noise), less, costs);
        if (!std::all_of(costs.begin(), costs.end(), [](double cost) { return std::isfinite(cost); }))
            continue;  // beyond the accuracy of numbers: as declared
        double* of_body = probabilities + b * kModels;
        weigh(costs, of_body);
        double mean = 0;
        for (int m = 0; m < kModels; ++m) mean += of_body[m] * std::log(shares[m]);
        P[b] = sum(predicted.P[b], std::exp(mean) - 1, noise);
        information[b] = inverse(P[b]);
        weighed.push_back(b);
    }
    return weighed;
}

}  // namespace roundel::fusion
