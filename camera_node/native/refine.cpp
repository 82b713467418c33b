// SPDX-License-Identifier: BSD-3-Clause
#include "refine.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <vector>

#include "cholesky.hpp"

namespace roundel {

namespace {

enum Parameter {
    kX,
    kY,
    kAxx,
    kAxy,
    kAyy,
    kRatio,
    kOffsetX,
    kOffsetY,
    kBright,
    kDark,
    kGround,
    kBlur,
    kCard,
    kCount
};
using Parameters = Vector<kCount>;
using Matrix = std::array<Parameters, kCount>;

constexpr double kBand = 2;       // pixels on either side of an edge that are used
constexpr int kMaxPixels = 1200;  // larger roundels are sampled on a coarser grid
constexpr int kMaxIterations = 12;
constexpr double kStep = 4e-3;     // pixels: a step below it is the last, and leaves an error of far less
constexpr double kNoiseFloor = 1;  // grey levels
constexpr double kMinBlur = 0.29;  // pixels: a pixel's own width alone
constexpr double kTukey = 6;       // standard deviations from which on a pixel does not count
constexpr double kCardRatio = 9.0 / 7;

struct Pixel {
    double x, y, level;
};

/// Signed distance of a point to the ellipse centre + r A u, |u| = 1, to first order (positive outside), and
/// its derivatives by the centre, by A = [[xx, xy], [xy, yy]] and by r.
struct Edge {
    double distance, by_x, by_y, by_axx, by_axy, by_ayy, by_r, curvature;
};

double square(double x) { return x * x; }
double cube(double x) { return x * x * x; }

Edge edge(const Symmetric& inverse, double r, double dx, double dy) {
    const double qx = inverse.xx * dx + inverse.xy * dy, qy = inverse.xy * dx + inverse.yy * dy;
    const double wx = inverse.xx * qx + inverse.xy * qy, wy = inverse.xy * qx + inverse.yy * qy;
    const double f = std::sqrt(qx * qx + qy * qy) + 1e-9, per_f = 1 / f;
    const double per_w = 1 / (std::sqrt(wx * wx + wy * wy) + 1e-9), stretch = f * per_w;
    const double nx = wx * per_w, ny = wy * per_w, ux = r * qx * per_f, uy = r * qy * per_f;
    return {(f - r) * stretch,    -nx,      -ny,      -nx * ux,
            -(nx * uy + ny * ux), -ny * uy, -stretch, cube(stretch) * square(inverse.det()) / r};
}

/// The share of the inside that a pixel sees near a blurred edge, and its derivatives by distance and by
/// blur.
struct Step {
    double inside, slope, by_blur;
};

/// Blur moves the half level of a curved edge towards its centre of curvature by curvature blur^2 / 2.
Step step(const Edge& edge, double blur) {
    const double shift = edge.curvature * blur * blur / 2, t = (edge.distance + shift) / blur;
    if (std::abs(t) > 5) return {t < 0 ? 1.0 : 0.0, 0, 0};
    const double slope = -std::exp(-t * t / 2) / (blur * std::sqrt(2 * std::numbers::pi));
    return {std::erfc(t / std::numbers::sqrt2) / 2, slope, slope * (shift - edge.distance) / blur};
}

Symmetric invert(const Parameters& p) {
    const Symmetric A{p[kAxx], p[kAxy], p[kAyy]};
    return {A.yy / A.det(), -A.xy / A.det(), A.xx / A.det()};
}

/// The model's grey level of a pixel, and its gradient.
class Model {
  public:
    explicit Model(const Parameters& p) : p_(p), inverse_(invert(p)) {
        // The centres of concentric circles' images stand on a line, as far from each other as their radii
        // squared.
        card_shift_ = (p[kCard] * p[kCard] - 1) / (p[kRatio] * p[kRatio] - 1);
    }

    double operator()(double x, double y, Parameters& J) const {
        const double dx = x - p_[kX], dy = y - p_[kY];
        const Edge outer = edge(inverse_, 1, dx, dy);
        const Edge inner = edge(inverse_, p_[kRatio], dx - p_[kOffsetX], dy - p_[kOffsetY]);
        const Edge card =
            edge(inverse_, p_[kCard], dx - card_shift_ * p_[kOffsetX], dy - card_shift_ * p_[kOffsetY]);
        const Step o = step(outer, p_[kBlur]), i = step(inner, p_[kBlur]), c = step(card, p_[kBlur]);
        const double fall = p_[kDark] - p_[kBright], drop = p_[kGround] - p_[kBright];
        const double by_o = fall * o.slope, by_i = -fall * i.slope, by_c = -drop * c.slope;
        J[kX] = by_o * outer.by_x + by_i * inner.by_x + by_c * card.by_x;
        J[kY] = by_o * outer.by_y + by_i * inner.by_y + by_c * card.by_y;
        J[kAxx] = by_o * outer.by_axx + by_i * inner.by_axx + by_c * card.by_axx;
        J[kAxy] = by_o * outer.by_axy + by_i * inner.by_axy + by_c * card.by_axy;
        J[kAyy] = by_o * outer.by_ayy + by_i * inner.by_ayy + by_c * card.by_ayy;
        J[kRatio] = by_i * inner.by_r;
        J[kOffsetX] = by_i * inner.by_x + card_shift_ * by_c * card.by_x;
        J[kOffsetY] = by_i * inner.by_y + card_shift_ * by_c * card.by_y;
        J[kBright] = c.inside - o.inside + i.inside;
        J[kDark] = o.inside - i.inside;
        J[kGround] = 1 - c.inside;
        J[kBlur] = fall * (o.by_blur - i.by_blur) - drop * c.by_blur;
        J[kCard] = by_c * card.by_r;
        return p_[kBright] + fall * J[kDark] + drop * J[kGround];
    }

  private:
    const Parameters& p_;
    Symmetric inverse_;
    double card_shift_;
};

/// Starting values: A is the symmetric square root that maps the unit circle to the ellipse.
Parameters begin(const Start& s) {
    const double c = std::cos(s.outer.angle), n = std::sin(s.outer.angle);
    const double a = s.outer.major / 2, b = s.outer.minor / 2;
    Parameters p{};
    p[kX] = s.outer.x, p[kY] = s.outer.y;
    p[kAxx] = a * c * c + b * n * n, p[kAxy] = (a - b) * c * n, p[kAyy] = a * n * n + b * c * c;
    p[kRatio] = s.ratio, p[kCard] = kCardRatio, p[kBlur] = 0.8;
    p[kDark] = s.dark, p[kBright] = p[kGround] = s.bright;
    return p;
}

/// What is known before a pixel is seen, as information (1 / variance): wide, only to hold what the pixels
/// don't tell.
Parameters prior_information() {
    Parameters w{};
    w[kRatio] = 1 / (0.3 * 0.3), w[kOffsetX] = w[kOffsetY] = 1.0;
    w[kGround] = 1 / (100.0 * 100), w[kBlur] = 1 / (1.0 * 1.0), w[kCard] = 1 / (0.05 * 0.05);
    return w;
}

std::vector<Pixel> select_pixels(const ImageView& image, const Parameters& p, const Ellipse& e) {
    const Symmetric inverse = invert(p);
    const double edges = std::numbers::pi * (e.major + e.minor) / 2 * (1 + p[kRatio]);
    const int grid = std::max(1, int(std::ceil(std::sqrt(edges * 2 * kBand / kMaxPixels))));
    const double half_width = std::hypot(p[kAxx], p[kAxy]) + kBand,
                 half_height = std::hypot(p[kAxy], p[kAyy]) + kBand;
    const int left = std::max(0, int(std::ceil(e.x - half_width))),
              top = std::max(0, int(std::ceil(e.y - half_height)));
    const int right = std::min(image.width - 1, int(e.x + half_width));
    const int bottom = std::min(image.height - 1, int(e.y + half_height));
    std::vector<Pixel> pixels;
    for (int y = top; y <= bottom; y += grid)
        for (int x = left; x <= right; x += grid) {
            const double dx = x - p[kX], dy = y - p[kY];
            if (edge(inverse, kCardRatio, dx, dy).distance > 0) continue;
            if (std::abs(edge(inverse, 1, dx, dy).distance) < kBand ||
                std::abs(edge(inverse, p[kRatio], dx, dy).distance) < kBand)
                pixels.push_back({double(x), double(y), double(image.row(y)[x])});
        }
    return pixels;
}

double tukey(double residual, double scale) {
    const double t = residual / (kTukey * scale);
    return std::abs(t) < 1 ? (1 - t * t) * (1 - t * t) : 0;
}

/// Gauss-Newton on one set of pixels.
class Solver {
  public:
    Solver(const std::vector<Pixel>& pixels, const Parameters& start)
        : p(start), pixels_(pixels), start_(start), residuals_(pixels.size()) {}

    /// Iterates until the step is small; false where the equations are singular or the fit goes astray.
    bool solve() {
        scale_ = (start_[kBright] - start_[kDark]) / 4;
        for (int k = 0; k < kMaxIterations; ++k) {
            accumulate();
            const Cholesky<kCount> factor(H_);
            if (!factor.positive()) return false;
            const Parameters delta = factor.solve(g_);
            double moved = 0;
            for (int i = 0; i < kCount; ++i) p[i] += delta[i];
            for (int i = 0; i <= kAyy; ++i) moved = std::max(moved, std::abs(delta[i]));
            p[kBlur] = std::max(p[kBlur], kMinBlur);
            if (!is_sane()) return false;
            if (moved < kStep) break;
        }
        accumulate();
        return true;
    }

    /// Covariance of two neighbouring parameters at the solution; nothing where the equations are singular.
    std::optional<Symmetric> covariance(Parameter first, Parameter second) const {
        const Cholesky<kCount> factor(H_);
        if (!factor.positive()) return std::nullopt;
        Parameters ex{}, ey{};
        ex[first] = ey[second] = noise_ * noise_;
        const Parameters x = factor.solve(ex), y = factor.solve(ey);
        return Symmetric{x[first], x[second], y[second]};
    }

    double residual() const { return rms_; }

    Parameters p;

  private:
    /// Normal equations H delta = g of the weighted residuals and the prior.
    void accumulate() {
        const Model model(p);
        H_ = {}, g_ = {};
        double weights = 0, weighted = 0, squares = 0;
        for (size_t k = 0; k < pixels_.size(); ++k) {
            Parameters J;
            const double r = pixels_[k].level - model(pixels_[k].x, pixels_[k].y, J);
            const double w = tukey(r, scale_);
            residuals_[k] = std::abs(r);
            squares += r * r, weights += w, weighted += w * r * r;
            for (int i = 0; i < kCount; ++i) {
                const double wj = w * J[i];
                g_[i] += wj * r;
                for (int j = 0; j <= i; ++j) H_[i][j] += wj * J[j];
            }
        }
        rms_ = std::sqrt(squares / double(pixels_.size()));
        noise_ = std::max(kNoiseFloor, std::sqrt(weighted / std::max(1.0, weights - double(kCount))));
        add_prior();
        update_scale();
    }

    void add_prior() {
        static const Parameters information = prior_information();
        for (int i = 0; i < kCount; ++i) {
            H_[i][i] += noise_ * noise_ * information[i];
            const double mean = i == kOffsetX || i == kOffsetY ? 0 : start_[i];
            g_[i] += noise_ * noise_ * information[i] * (mean - p[i]);
        }
    }

    /// Tukey's scale for the next step: the median of the residuals (1.48 of it is a standard deviation).
    void update_scale() {
        const auto middle = residuals_.begin() + ptrdiff_t(residuals_.size() / 2);
        std::nth_element(residuals_.begin(), middle, residuals_.end());
        scale_ = std::max(kNoiseFloor, 1.48 * *middle);
    }

    bool is_sane() const {
        const double size = std::sqrt(start_[kAxx] * start_[kAyy] - start_[kAxy] * start_[kAxy]);
        const double area = p[kAxx] * p[kAyy] - p[kAxy] * p[kAxy];
        return std::hypot(p[kX] - start_[kX], p[kY] - start_[kY]) < 1 + 0.1 * size && p[kAxx] > 0 &&
               std::sqrt(std::max(area, 0.0)) > 0.7 * size && std::sqrt(std::max(area, 0.0)) < 1.4 * size &&
               p[kRatio] > 0.1 && p[kRatio] < 0.95 && p[kBlur] < 3 + 0.1 * size && p[kCard] > 1;
    }

    const std::vector<Pixel>& pixels_;
    Parameters start_;
    std::vector<double> residuals_;
    Matrix H_{};
    Parameters g_{};
    double scale_ = 0, rms_ = 0, noise_ = 0;
};

}  // namespace

std::optional<Fit> refine(const ImageView& image, const Start& start) {
    const Parameters first = begin(start);
    const std::vector<Pixel> pixels = select_pixels(image, first, start.outer);
    if (pixels.size() < 2 * kCount) return std::nullopt;
    Solver solver(pixels, first);
    if (!solver.solve()) return std::nullopt;
    const auto centre = solver.covariance(kX, kY), offset = solver.covariance(kOffsetX, kOffsetY);
    if (!centre || !offset) return std::nullopt;
    const Parameters& p = solver.p;
    const Eigen axes = eigen({p[kAxx], p[kAxy], p[kAyy]});
    // Perspective moves a circle's centre by its radius squared: the inner circle's image tells that of
    // radius nought.
    const double to_disc = 1 / (1 - p[kRatio] * p[kRatio]);
    return Fit{.outer = {p[kX], p[kY], 2 * axes.first, 2 * axes.second, axes.angle},
               .covariance = *centre,
               .offset_x = to_disc * p[kOffsetX],
               .offset_y = to_disc * p[kOffsetY],
               .offset_covariance = offset->scaled(to_disc * to_disc),
               .ratio = p[kRatio],
               .card = p[kCard],
               .dark = p[kDark],
               .bright = p[kBright],
               .blur = p[kBlur],
               .residual = solver.residual()};
}

}  // namespace roundel
