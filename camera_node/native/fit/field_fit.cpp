// SPDX-License-Identifier: BSD-3-Clause
#include <algorithm>
#include <cmath>

#include "fit/photometric_fitter.hpp"
#include "numeric/cholesky.hpp"

namespace roundel {

namespace {

constexpr int kFieldSteps = 8;
constexpr double kFirstScale = 0.1;   // of the contrast: residuals of the first step
constexpr double kFieldChange = 0.1;  // of a standard deviation: a smaller step ends the iteration
// Standard deviations of the fields:
constexpr double kLightSigma = 0.3;   // light over its mean, and gloss over the contrast, up to second order
constexpr double kCubicSigma = 0.05;  // the same of third order
constexpr double kBendSigma = 0.02;   // height of bent paper over its width, as displacement with three
                                      // periods at a tilt of 45 degrees
constexpr double kLeastTilt = 0.05;
// Residuals from which a fit is no roundel on bent paper, over the contrast: a bend of 2 % leaves 0.14 at 160
// px.
constexpr double kMaxBentResidual = 0.2;
// Standard deviation of the level around a card in uneven light, over the contrast: no function of light is
// as good there as on the print.
constexpr double kUnevenGround = 0.04;

}  // namespace

bool PhotometricFitter::shows_bend() {
    if (occlusion_.any()) return false;
    Parameters step = p_;
    for (int i = 0; i < kCount; ++i) step[i] -= linearized_at_[i];
    scores_ = score_fields(equations_, pixels_, FieldFrame(p_), step, {scale_, spread_});
    for (double* score : {&scores_.bend, &scores_.light, &scores_.processing}) *score /= square(noise_);
    return allowed_ == AllowedFields::kBend && scores_.bend > kUnlikelyField &&
           scale_ < kMaxBentResidual * contrast();
}

/// The prior information on each field.
Vector<kFields> PhotometricFitter::field_prior() const {
    const auto from_sigma = [](double sigma) { return 1 / square(sigma); };
    const bool light = allowed_ == AllowedFields::kAll;
    constexpr double kNever = 1e-9;
    Vector<kFields> prior;
    for (int i = 0; i < kLightFields; ++i) {
        const double sigma = !light ? kNever : i < kCubic ? kLightSigma : kCubicSigma;
        prior[size_t(kLight + i)] = from_sigma(sigma);
        prior[size_t(kGloss + i)] = from_sigma(sigma * contrast());
    }
    prior[kBend] = prior[kBend + 1] = from_sigma(kBendSigma * std::max(kLeastTilt, fields_.frame.tilt()));
    return prior;
}

/// Gauss-Newton steps of the parameters and the fields. The pixels are selected again for each, since the
/// fields change their places and levels.
bool PhotometricFitter::fit_fields() {
    fields_ = {FieldFrame(p_), {}};
    has_fields_ = true;
    fields_.frame.x += pixels_.origin_x;
    fields_.frame.y += pixels_.origin_y;
    const Vector<kFields> prior = field_prior();
    const double ground = spread_;  // that the fit in even light shows
    for (int k = 0; k < kFieldSteps; ++k) {
        if (!select(whole_band(), EdgePixels::kMax)) return false;
        equations_.linearize(pixels_, p_);
        linearized_at_ = p_;
        const double seen = edge_scale();
        // The first step weights all pixels: what the fields explain shall not count as outliers.
        scale_ = k ? std::clamp(scale_, kStrictScale * seen, kSlackScale * seen)
                   : std::max(seen, kFirstScale * contrast());
        if (allowed_ == AllowedFields::kAll)
            spread_ = std::max(ground, kPatch * square(kUnevenGround * contrast() / scale_));
        if (!solve(scale_)) return false;
        double moved = 0;
        if (!step_with_fields(prior, moved) || !is_sane(kFitLimits)) return false;
        if (k > 1 && moved < kFieldChange * noise_) break;
    }
    return true;
}

/// With C the products of the fields' columns with those of the parameters, D their own, e their residuals
/// and L their prior, eliminates the parameters:
///   S = D + L - C^T H^-1 C,  fields <- fields + S^-1 (e - C^T step - L fields),
/// and the parameters' step decreases by H^-1 C times that change.
bool PhotometricFitter::step_with_fields(const Vector<kFields>& prior, double& moved) {
    Parameters step = factor_->solve(system_.g);
    FieldFrame frame = fields_.frame;
    frame.x -= pixels_.origin_x;
    frame.y -= pixels_.origin_y;
    const auto products = field_products(equations_, pixels_, frame, {scale_, spread_});
    std::array<Vector<kFields>, kFields> S = products.own;
    std::array<Parameters, kFields> half;
    Vector<kFields> right = products.residuals;
    for (size_t a = 0; a < kFields; ++a) {
        half[a] = factor_->halfway(products.parameters[a]);
        for (size_t b = 0; b <= a; ++b)
            for (size_t i = 0; i < kCount; ++i) S[a][b] -= half[a][i] * half[b][i];
        S[a][a] += square(scale_) * prior[a];
        right[a] -= square(scale_) * prior[a] * fields_.of[a];
        for (size_t i = 0; i < kCount; ++i) right[a] -= products.parameters[a][i] * step[i];
    }
    const Cholesky<kFields> factor(S);
    if (!factor.positive()) return false;
    Vector<kFields> change = factor.solve(right);
    if (allowed_ != AllowedFields::kAll)
        std::fill_n(change.begin(), size_t(kBend), 0.0);  // the prior forbids it
    for (size_t a = 0; a < kFields; ++a) {
        by_field_[a] = factor_->solve_tail<kCount>(half[a]);
        for (size_t i = 0; i < kCount; ++i) step[i] -= by_field_[a][i] * change[a];
    }
    field_cov_ = factor.inverse_tail<kFields>();
    sums_ = equations_.residuals_after(step, {scale_, spread_});
    update_noise();
    for (size_t a = 0; a < kFields; ++a) fields_.of[a] += change[a];
    apply(step);
    moved = std::sqrt(level_change(step) / double(std::max(1, pixels_.used)));
    return true;
}

/// Adds what the errors of the fields contribute to the covariance, in units of the noise.
void PhotometricFitter::add_fields(PoseCovariance& inverse) const {
    for (size_t a = 0; a < kFields; ++a)
        for (size_t b = 0; b < kFields; ++b)
            for (size_t i = 0; i < kPoseCount; ++i)
                for (size_t j = 0; j < kPoseCount; ++j)
                    inverse[i][j] += by_field_[a][kX + i] * field_cov_[a][b] * by_field_[b][kX + j];
}

/// The bend that the fit contains, or what the residuals show of one that it does not.
Bend PhotometricFitter::bend() const {
    if (has_fields_)
        return {square(fields_.bend()),
                square(noise_) * (field_cov_[kBend][kBend] + field_cov_[kBend + 1][kBend + 1]) / 2,
                scores_.processing};
    if (!(scores_.bend_information > 0)) return {};
    const double variance = square(noise_) / scores_.bend_information;
    return {scores_.bend * variance, variance, scores_.processing};
}

/// Includes the two unknowns of a linear shading in the pose, after convergence: with C the products of their
/// columns with those of the parameters, D their own, e their residuals, and L and m the information and the
/// mean of the prior,
///   S = D + L - C^T H^-1 C,  shading = S^-1 (e - C^T step + L m),  pose <- pose - (H^-1 C shading)_pose.
/// The covariance grows by H^-1 C S^-1 C^T H^-1. The shading is relative to the level at the pixels' origin.
void PhotometricFitter::allow_shading() {
    const auto products = shading_products(equations_, pixels_, {scale_, spread_});
    const auto& [Cx, Cy] = products.parameters;
    const Parameters yx = factor_->halfway(Cx), yy = factor_->halfway(Cy);
    Symmetric S{products.own[0][0], products.own[1][0], products.own[1][1]};
    double ex = products.residuals[0] / slope_, ey = products.residuals[1] / slope_;
    for (int i = 0; i < kCount; ++i) {
        const double step = p_[i] - linearized_at_[i];
        ex -= Cx[i] * step;
        ey -= Cy[i] * step;
        S.xx -= yx[i] * yx[i];
        S.xy -= yx[i] * yy[i];
        S.yy -= yy[i] * yy[i];
    }
    if (!(S.det() > 0 && S.xx > 0)) return;
    shading_ = {(S.yy * ex - S.xy * ey) / S.det(), (S.xx * ey - S.xy * ex) / S.det(),
                square(noise_) * (S.xx + S.yy) / (2 * S.det())};
    const double prior = square(noise_ / light_.sigma);
    S.xx += prior;
    S.yy += prior;
    ex += prior * light_.x;
    ey += prior * light_.y;
    const double det = S.det();
    const double sx = (S.yy * ex - S.xy * ey) / det, sy = (S.xx * ey - S.xy * ex) / det;
    const auto Kx = factor_->solve_tail<kPoseCount>(yx), Ky = factor_->solve_tail<kPoseCount>(yy);
    for (int i = 0; i < kPoseCount; ++i) p_[kX + i] -= Kx[i] * sx + Ky[i] * sy;
    for (int i = 0; i < kPoseCount; ++i)
        for (int j = 0; j < kPoseCount; ++j)
            shading_effect_[i][j] =
                (S.yy * Kx[i] * Kx[j] - S.xy * (Kx[i] * Ky[j] + Ky[i] * Kx[j]) + S.xx * Ky[i] * Ky[j]) / det;
}

}  // namespace roundel
