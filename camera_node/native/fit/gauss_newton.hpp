// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <optional>

#include "fit/photometric_fit.hpp"
#include "fit/roundel_model.hpp"
#include "numeric/cholesky.hpp"

namespace roundel {

constexpr double kMinBlur = 0.29;       // pixels: standard deviation of the pixel's own width
constexpr double kShortestFocal = 400;  // pixels: no lens in use has a stronger perspective
constexpr double kPatch = 64;           // pixels of the ground with correlated levels

/// The parameters of an initial guess, in a frame with its origin at pixel (x, y). A is the symmetric square
/// root that maps the unit circle to the ellipse.
inline Parameters initial_parameters(const InitialGuess& guess, int origin_x, int origin_y, double blur) {
    const Symmetric A = from_eigenvalues(guess.outer.major / 2, guess.outer.minor / 2, guess.outer.angle);
    Parameters p{};
    p[kX] = guess.outer.x - origin_x;
    p[kY] = guess.outer.y - origin_y;
    p[kAxx] = A.xx;
    p[kAxy] = A.xy;
    p[kAyy] = A.yy;
    p[kRatio] = guess.ratio;
    p[kCard] = kCardRatio;
    p[kBlur] = blur;
    p[kDark] = guess.dark;
    p[kBright] = p[kGround] = guess.bright;
    return p;
}

/// The prior information (1 / variance) of each parameter. It is weak: it only constrains parameters that the
/// pixels do not determine. `ratio` and `blur` are the prior standard deviations of these two.
inline Parameters prior_information(double major, double ratio, double blur) {
    const auto from_sigma = [](double sigma) { return 1 / (sigma * sigma); };
    Parameters w{};
    w[kRatio] = from_sigma(ratio);
    w[kCard] = from_sigma(0.05);
    w[kGround] = from_sigma(100);
    w[kBlur] = from_sigma(blur);
    const double perspective = kShortestFocal / (major / 2);  // g = r / f sin(tilt)
    w[kGx] = w[kGy] = perspective * perspective;
    return w;
}

/// How far an estimate may be from its initial guess.
struct SanityLimits {
    double shift;      // of the centre, mean radii; one pixel more is always allowed
    double min_size;   // mean radius over that of the guess
    double max_size;   // mean radius over that of the guess
    double blur;       // mean radii; three pixels more are always allowed
    double underflow;  // grey levels below 0
    double overflow;   // grey levels above 255
};

/// J^T W J, of which the lower triangle is set, and J^T W r.
template <int N>
struct GaussNewtonSystem {
    std::array<Vector<N>, N> H;
    Vector<N> g;
};

/// Gauss-Newton iteration with a Gaussian prior on N unknowns, the last of which are the `Parameters` of a
/// picture. The fits of still and of moving roundels share it.
template <int N>
class GaussNewton {
  protected:
    static constexpr int kPicture = N - kCount;  // index of the first of the picture's parameters

    /// Adds the prior to the system and factorizes it; false if it is singular. `noise` is the standard
    /// deviation of a residual, grey levels.
    bool factorize(GaussNewtonSystem<N>& system, double noise) {
        for (int i = 0; i < N; ++i) {
            const double information = noise * noise * prior_[size_t(i)];
            system.H[i][i] += information;
            system.g[i] += information * (start_[i] - p_[i]);
        }
        factor_.emplace(system.H);
        return factor_->positive();
    }

    void apply(const Vector<N>& delta) {
        for (int i = 0; i < N; ++i) p_[i] += delta[i];
        p_[kPicture + kBlur] = std::max(p_[kPicture + kBlur], kMinBlur);
    }

    double contrast() const { return at(kBright) - at(kDark); }
    double start_radius() const { return std::sqrt(radius_squared(start_)); }

    bool is_sane(const SanityLimits& limits) const {
        const double radius = start_radius(), area = radius_squared(p_) / radius_squared(start_);
        const double dx = at(kX) - start_[kPicture + kX], dy = at(kY) - start_[kPicture + kY];
        return std::hypot(dx, dy) < 1 + limits.shift * radius && at(kAxx) > 0 &&
               area > square(limits.min_size) && area < square(limits.max_size) && at(kRatio) > 0.1 &&
               at(kRatio) < 0.95 && at(kBlur) < 3 + limits.blur * radius && at(kCard) > 1 &&
               at(kDark) > -limits.underflow && at(kBright) < 255 + limits.overflow &&
               square(at(kGx)) + square(at(kGy)) < square(0.5 / at(kCard));
    }

    Vector<N> p_{};      // the estimate
    Vector<N> start_{};  // the mean of the prior
    Vector<N> prior_{};  // the information of the prior
    std::optional<Cholesky<N>> factor_;

  private:
    double at(Parameter parameter) const { return p_[kPicture + parameter]; }
    /// det A: the product of the ellipse's half axes.
    static double radius_squared(const Vector<N>& p) {
        return p[kPicture + kAxx] * p[kPicture + kAyy] - square(p[kPicture + kAxy]);
    }
};

}  // namespace roundel
