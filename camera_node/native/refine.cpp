// SPDX-License-Identifier: BSD-3-Clause
#include "refine.hpp"

#include <algorithm>
#include <cmath>

#include "cholesky.hpp"
#include "edge_pixels.hpp"
#include "normal_equations.hpp"

namespace roundel {

namespace {

constexpr double kBand = 2.5;       // pixels on either side of an edge that are used, at the least
constexpr double kBandBlurs = 2.5;  // blurs, likewise
constexpr int kCoarsePixels = 300;
constexpr int kMaxSteps = 12;
constexpr int kSample = 128;
constexpr int kEdgeUnknowns = kCount - 3;  // all but the levels
constexpr double kScale = 1.06;    // standard deviation of Gaussian noise over that of its weighed residuals
constexpr double kNoiseFloor = 1;  // grey levels
constexpr double kMinBlur = 0.29;  // pixels: a pixel's own width alone
constexpr double kStartBlur = 0.8;
constexpr double kCardRatio = 9.0 / 7;
constexpr double kShortestFocal = 400;  // pixels: no lens shows more perspective

/// Starting values: A is the symmetric square root that maps the unit circle to the ellipse.
Parameters begin(const Start& s, const EdgePixels& frame) {
    const double c = std::cos(s.outer.angle), n = std::sin(s.outer.angle);
    const double a = s.outer.major / 2, b = s.outer.minor / 2;
    Parameters p{};
    p[kX] = s.outer.x - frame.origin_x, p[kY] = s.outer.y - frame.origin_y;
    p[kAxx] = a * c * c + b * n * n, p[kAxy] = (a - b) * c * n, p[kAyy] = a * n * n + b * c * c;
    p[kRatio] = s.ratio, p[kCard] = kCardRatio, p[kBlur] = kStartBlur;
    p[kDark] = s.dark, p[kBright] = p[kGround] = s.bright;
    return p;
}

double square(double x) { return x * x; }

/// What is known before a pixel is seen, as information (1 / variance): wide, only to hold what the pixels
/// don't tell.
Parameters prior_information(double major) {
    Parameters w{};
    w[kRatio] = 1 / square(0.3), w[kCard] = 1 / square(0.05);
    w[kGround] = 1 / square(100), w[kBlur] = 1 / square(1);
    w[kGx] = w[kGy] = square(kShortestFocal / (major / 2));  // g = r / f sin(tilt)
    return w;
}

/// Gauss-Newton on the pixels near one roundel's edges.
class Fitter {
  public:
    Fitter(const ImageView& image, const Start& start) : image_(image) {
        pixels_.origin_x = int(std::lround(start.outer.x));
        pixels_.origin_y = int(std::lround(start.outer.y));
        p = start_ = begin(start, pixels_);
        prior_ = prior_information(start.outer.major);
    }

    bool solve() {
        // Perspective moves the inner edge and the card's from where the start has them.
        const double unknown = 0.01 * (start_[kAxx] + start_[kAyy]);
        if (!select(kBand + unknown, kCoarsePixels)) return false;
        scale_ = start_scale();
        if (!iterate()) return false;
        if (step_ == 1 && p[kBlur] * kBandBlurs < kBand) return true;
        return select(std::max(kBand, kBandBlurs * p[kBlur]), EdgePixels::kMax) && iterate();
    }

    Fit fit() const;
    Parameters p;

  private:
    bool select(double band, int limit) {
        step_ = select_pixels(image_, p, band, limit, pixels_);
        return pixels_.used >= 2 * kCount;
    }

    /// The median of the residuals of a sample of the ring's edges (1.48 of it is a standard deviation).
    double start_scale() const {
        float residuals[kSample + kLanes];
        const int n = sample_residuals(pixels_, p, kSample, residuals);
        if (n < kLanes) return (p[kBright] - p[kDark]) / 4;
        std::nth_element(residuals, residuals + n / 2, residuals + n);
        return std::max(kNoiseFloor, 1.48 * residuals[n / 2]);
    }

    /// Steps until one's own error, of the order of its square over the blur, is small against the standard
    /// deviation.
    bool iterate() {
        for (int k = 0; k < kMaxSteps; ++k) {
            const double used = scale_;
            sums_ = accumulate(pixels_, p, used);
            add_prior();
            const Cholesky<kCount> factor(sums_.H);
            if (!factor.positive()) return false;
            const double moved = advance(factor);
            if (!is_sane()) return false;
            const double deviation = noise_ / std::sqrt(sums_.H[kX][kX] + sums_.H[kY][kY]);
            if (moved * moved < 0.2 * p[kBlur] * deviation && scale_ > 0.7 * used) return true;
        }
        return true;
    }

    void add_prior() {
        const double noise = std::max(kNoiseFloor, std::sqrt(sums_.mrr / sums_.m));
        for (int i = 0; i < kCount; ++i) {
            const double information = noise * noise * prior_[i];
            sums_.H[i][i] += information;
            sums_.g[i] += information * (start_[i] - p[i]);
        }
    }

    /// Takes a step, foretells the residuals after it, and gives its greatest move in pixels.
    double advance(const Cholesky<kCount>& factor) {
        const Parameters delta = factor.solve(sums_.g);
        double moved = std::abs(delta[kBlur]), fall = 0;
        for (int i = 0; i < kCount; ++i) p[i] += delta[i], fall += delta[i] * sums_.g[i];
        for (int i = kX; i <= kAyy; ++i) moved = std::max(moved, std::abs(delta[i]));
        p[kBlur] = std::max(p[kBlur], kMinBlur);
        update_noise(fall);
        return moved;
    }

    /// What residuals on the edges are left when a step takes `fall` off the sum of squares, most of it
    /// there; `freedom` is the share of them that the unknowns do not follow.
    void update_noise(double fall) {
        const double left = sums_.mm / sums_.m * fall;
        const double freedom = std::max(0.1, 1 - kEdgeUnknowns * sums_.mm / square(sums_.m));
        const double slope = std::max(0.5, sums_.mpsi / sums_.m);
        // After a long step what is left is too small a difference to be trusted.
        const double mrr = std::max(sums_.mrr / 4, sums_.mrr - left);
        const double mwrr = std::max(sums_.mwrr / 4, sums_.mwrr - left);
        scale_ = std::max(kNoiseFloor, kScale * std::sqrt(mrr / (sums_.m * freedom)));
        noise_ = std::max(kNoiseFloor, std::sqrt(mwrr / (sums_.m * freedom)) / slope);
        agreeing_ = std::sqrt(std::max(0.0, sums_.wrr - fall) / std::max(1.0, sums_.w));
    }

    bool is_sane() const {
        const double size = start_[kAxx] * start_[kAyy] - square(start_[kAxy]);
        const double area = (p[kAxx] * p[kAyy] - square(p[kAxy])) / size;
        return std::hypot(p[kX] - start_[kX], p[kY] - start_[kY]) < 1 + 0.1 * std::sqrt(size) &&
               p[kAxx] > 0 && area > square(0.7) && area < square(1.4) && p[kRatio] > 0.1 &&
               p[kRatio] < 0.95 && p[kBlur] < 3 + 0.1 * std::sqrt(size) && p[kCard] > 1 &&
               square(p[kGx]) + square(p[kGy]) < square(0.5 / p[kCard]);
    }

    const ImageView& image_;
    EdgePixels pixels_;
    Parameters start_, prior_;
    NormalEquations sums_;
    int step_ = 1;
    double scale_ = 0, noise_ = 0, agreeing_ = 0;
};

/// The outer ellipse's centre and the disc's own less it, by the pose: e = c - A g, to first order in g.
std::array<Vector<kCount - kPose>, 4> centres_by_pose(const Parameters& p) {
    const double gx = p[kGx], gy = p[kGy];
    const Vector<7> hx{0, 0, gx, gy, 0, p[kAxx], p[kAxy]}, hy{0, 0, 0, gx, gy, p[kAxy], p[kAyy]};
    std::array<Vector<7>, 4> T{};
    T[2] = hx, T[3] = hy;
    for (int k = 0; k < 7; ++k) T[0][k] = (k == 0) - hx[k], T[1][k] = (k == 1) - hy[k];
    return T;
}

Fit Fitter::fit() const {
    const CircleImage outer = circle_image(p, 1);
    const Eigen axes = eigen(outer.shape);
    const auto inverse = Cholesky<kCount>(sums_.H).inverse_tail<kCount - kPose>();
    const auto T = centres_by_pose(p);
    const auto covariance = [&](int a, int b) {
        double c = 0;
        for (int i = 0; i < 7; ++i)
            for (int j = 0; j < 7; ++j) c += T[a][i] * inverse[i][j] * T[b][j];
        return square(noise_) * c;
    };
    return {.outer = {outer.x + pixels_.origin_x, outer.y + pixels_.origin_y, 2 * std::sqrt(axes.first),
                      2 * std::sqrt(axes.second), axes.angle},
            .covariance = {covariance(0, 0), covariance(0, 1), covariance(1, 1)},
            .offset_x = p[kX] - outer.x,
            .offset_y = p[kY] - outer.y,
            .offset_covariance = {covariance(2, 2), covariance(2, 3), covariance(3, 3)},
            .ratio = p[kRatio],
            .card = p[kCard],
            .dark = p[kDark],
            .bright = p[kBright],
            .blur = p[kBlur],
            .residual = std::sqrt(sums_.rr / std::max(1.0, sums_.n)),
            .agreeing_residual = agreeing_,
            .support = sums_.agreeing / sums_.ring * pixels_.used / pixels_.expected};
}

}  // namespace

std::optional<Fit> refine(const ImageView& image, const Start& start) {
    Fitter fitter(image, start);
    if (!fitter.solve()) return std::nullopt;
    return fitter.fit();
}

}  // namespace roundel
