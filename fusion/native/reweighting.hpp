// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <array>
#include <optional>

#include "linearization.hpp"

namespace roundel::fusion {

constexpr double kCauchy = 4.0;  // whitened distance at which the weight of an observation is one half
/// Mean Cauchy weight of Gaussian noise in two dimensions, E[1 / (1 + chi2_2 / kCauchy^2)]. Weights are
/// divided by it, so that Gaussian noise keeps its information.
constexpr double kNominalWeight = 0.8983;

using ErrorVector = std::array<double, kErrors>;
using ErrorMatrix = std::array<ErrorVector, kErrors>;

/// The equations of N observations, each of one of K bodies.
struct EquationSystem {
    const Equations* equations;
    const int64_t* body;
    size_t n_equations, n_bodies;
};

/// The indices of the equations in the order of their bodies: those of body b are from `first[b]` to
/// `first[b + 1]`. It reads only `body` and the numbers of a system.
struct ByBody {
    std::vector<size_t> first, indices;

    explicit ByBody(const EquationSystem& system);
};

/// Adds weighted equations of one body to the lower triangle of their matrix, and to the right side.
void add(const std::vector<Equations>& equations, const std::vector<double>& weights, ErrorMatrix& H,
         ErrorVector& g);

/// Adds priors and weighted equations: iteratively reweighted least squares (Holland and Welsch 1977) with
/// Cauchy weights, until the weights of a body converge.
///
/// On entry the K matrices H and right sides g hold the priors, and the N `weights` the first weights. On
/// return they hold the sums with the last weights, and these weights. Where the sums of a body are singular
/// its weights do not change; the elimination reports it.
void reweigh(const EquationSystem& system, ErrorMatrix* H, ErrorVector* g, double* weights);

/// Writes 2 x N whitened residuals b - A delta of the steps delta (K x 12).
void residuals(const EquationSystem& system, const double* steps, double* to);

/// N assignments about the predicted bodies: by each the covariance of the centre (pixels^2), the logarithm
/// of the density of other roundels (per pixel^2), and the camera.
struct Evidence {
    EquationSystem system;
    Columns<4> cov;
    const double* log_density;
    const int64_t* camera;
};

/// K doubts whether the assignments of a body in a camera, or in any (-1), are its own: the logarithm of how
/// probable that is before, and the variance of both coordinates beside their own noise, pixels^2. Those of
/// one turn follow each other, and are judged given what was accepted in the turns before.
struct Doubts {
    const int64_t *body, *camera, *turn;
    const double *prior, *added_px2;
    size_t n;
};

/// Marks the assignments as certain that are more probable as the body's own than as any roundels of their
/// images, given those that are certain and the information of the predictions, by body.
void accept(const Evidence& evidence, const Doubts& doubts, const ErrorMatrix* information, bool* certain);

/// The inverse of a positive definite matrix, by symmetric sweeps (Goodnight 1979).
std::optional<ErrorMatrix> inverse_if_positive(const ErrorMatrix& H);

/// The same; throws std::runtime_error for other matrices.
ErrorMatrix inverse(const ErrorMatrix& H);

}  // namespace roundel::fusion
