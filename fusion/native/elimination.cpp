// SPDX-License-Identifier: BSD-3-Clause
#include "elimination.hpp"

#include <algorithm>
#include <stdexcept>
#include <vector>

#include "numeric/cholesky.hpp"

namespace roundel::fusion {
namespace {

/// The sums of one body: its block, and by column of the cameras its border; the last column is its right
/// side.
struct BodyBlock {
    ErrorMatrix H{};
    std::vector<ErrorVector> border;
};

/// Adds an observation to the block of its body and to the sums of its camera.
void add(const JointEquations& rows, double weight, size_t first, BodyBlock& block, double* reduced) {
    const size_t d = block.border.size() - 1;
    for (const auto& row : rows.D) {
        const double *by_camera = row + kErrors, residual = weight * row[kErrors + kCameraErrors];
        for (int i = 0; i < kErrors; ++i) {
            const double a = weight * row[i];
            for (int j = 0; j < kErrors; ++j) block.H[i][j] += a * row[j];
            for (int j = 0; j < kCameraErrors; ++j) block.border[first + j][i] += a * by_camera[j];
            block.border[d][i] += residual * row[i];
        }
        for (int i = 0; i < kCameraErrors; ++i) {
            double* to = reduced + (first + i) * (d + 1);
            for (int j = 0; j < kCameraErrors; ++j) to[first + j] += weight * by_camera[i] * by_camera[j];
            to[d] += residual * by_camera[i];
        }
    }
}

/// Subtracts border^T H^-1 border from the sums of the cameras that see the body, and writes H^-1 border.
void eliminate_body(BodyBlock& block, const std::vector<char>& is_seen, double* reduced, double* by_body) {
    const Cholesky<kErrors> factor(block.H);
    if (!factor.positive()) throw std::runtime_error("a robot of a keyframe is not determined");
    const size_t d = block.border.size() - 1;
    for (size_t j = 0; j <= d; ++j) {
        if (j < d && !is_seen[j / kCameraErrors]) continue;
        const ErrorVector solved = factor.solve(block.border[j]);
        for (int i = 0; i < kErrors; ++i) by_body[i * (d + 1) + j] = solved[i];
        for (size_t k = 0; k < d; ++k) {
            if (!is_seen[k / kCameraErrors]) continue;
            double product = 0;
            for (int i = 0; i < kErrors; ++i) product += block.border[k][i] * solved[i];
            reduced[k * (d + 1) + j] -= product;
        }
    }
}

}  // namespace

void eliminate(const JointSystem& system, const BodyPriors& priors, double* reduced, double* by_body) {
    const size_t d = kCameraErrors * system.n_cameras;
    std::fill_n(reduced, d * (d + 1), 0.0);
    std::fill_n(by_body, system.n_bodies * kErrors * (d + 1), 0.0);
    const ByBody of({nullptr, system.body, system.n_equations, system.n_bodies});
    for (size_t b = 0; b < system.n_bodies; ++b) {
        BodyBlock block;
        block.border.assign(d + 1, {});
        std::vector<char> is_seen(system.n_cameras);
        for (size_t at = of.first[b]; at < of.first[b + 1]; ++at) {
            const size_t k = of.indices[at];
            add(system.equations[k], system.weights[k], kCameraErrors * system.camera[k], block, reduced);
            is_seen[system.camera[k]] = true;
        }
        for (int i = 0; i < kErrors; ++i) {
            block.H[i][i] = (1 + priors.damping) * block.H[i][i] + priors.information[b][i];
            block.border[d][i] += priors.right[b][i];
        }
        eliminate_body(block, is_seen, reduced, by_body + b * kErrors * (d + 1));
    }
}

}  // namespace roundel::fusion
