// SPDX-License-Identifier: BSD-3-Clause
#include "verify/shadow_edge.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <optional>

#include "verify/learning.hpp"

namespace roundel {

namespace {

constexpr double kGuard = 1.5;   // pixels: a guess is off by one, and an edge is blurred by half of one more
constexpr double kPixels = 700;  // about so many of the disc are read: both levels to a tenth of the noise,
constexpr double kFew = 150;     // and of them for the first trials; with 100, 3 of 80 under gloss are lost
constexpr double kFirstWidth =
    0.2;                   // outer radii: of the edges of the first trials, and from one to the next
constexpr int kSteps = 8;  // of Gauss-Newton, from an edge that is off by half of that
// Share of the light: an edge that takes less leaves less than the residuals that pass without it, 0.045 of
// the contrast where half of the points lose their light.
constexpr double kVisible = 0.1;

/// A pixel of ring or paper, in outer radii from the centre.
struct Point {
    double x, y, level;
    bool is_ink;
};

enum LightParameter { kPaper, kInk, kLoss, kAt, kWidth, kCurve, kTurn };
constexpr int kUnknowns = kTurn + 1;
using Light = Vector<kUnknowns>;

/// The share of the light at a place, and what a step across the edge changes.
struct LightAt {
    double share, across, along, off, slope;
};

/// The light of some parameters.
class ShadowEdge {
  public:
    explicit ShadowEdge(const Light& q) : q_(q), c_(std::cos(q[kTurn])), s_(std::sin(q[kTurn])) {}
    LightAt at(double x, double y) const {
        const double across = c_ * x + s_ * y, along = c_ * y - s_ * x;
        const double off = across - q_[kAt] + q_[kCurve] / 2 * square(along), u = off / q_[kWidth];
        return {1 - q_[kLoss] * std::erfc(-u / std::numbers::sqrt2) / 2, across, along, off,
                -q_[kLoss] * std::exp(-u * u / 2) / (q_[kWidth] * std::sqrt(2 * std::numbers::pi))};
    }

  private:
    const Light& q_;
    double c_, s_;
};

std::vector<Point> read_points(const ImageView& image, const InitialGuess& guess, double count) {
    const Ellipse& e = guess.outer;
    const double a = e.major / 2, b = e.minor / 2, c = std::cos(e.angle), s = std::sin(e.angle);
    const double guard = kGuard / b, in_ring = std::min(guard, (1 - guess.ratio) / 3);
    const int step = std::max(1, int(std::lround(std::sqrt(std::numbers::pi * a * b / count))));
    const int reach = int(kCardRatio * a);
    std::vector<Point> points;
    for (int v = std::max(0, int(e.y) - reach); v <= std::min(image.height - 1, int(e.y) + reach); v += step)
        for (int u = std::max(0, int(e.x) - reach); u <= std::min(image.width - 1, int(e.x) + reach);
             u += step) {
            const double x = u - e.x, y = v - e.y;
            const double f = std::hypot((c * x + s * y) / a, (c * y - s * x) / b);
            const bool ink = f > guess.ratio + in_ring && f < 1 - in_ring;
            const bool paper = f < guess.ratio - guard || (f > 1 + guard && f < kCardRatio - guard);
            if (ink || paper) points.push_back({x / a, y / a, double(image.row(v)[u]), ink});
        }
    return points;
}

/// The best of some straight edges across the slope of the paper's levels, if it explains most of what one
/// level of paper and one of ink leave. The levels and the share of the light that is lost are linear for
/// paper, given the edge, and then for ink.
std::optional<Light> find_edge(const std::vector<Point>& points) {
    double n = 0, l = 0, ll = 0, n_ink = 0, ink = 0, squared_ink = 0;
    Regression<3> slope;
    for (const Point& p : points) {
        (p.is_ink ? n_ink : n) += 1;
        (p.is_ink ? ink : l) += p.level;
        (p.is_ink ? squared_ink : ll) += square(p.level);
        if (!p.is_ink) slope.include({1, p.x, p.y}, p.level, 1);
    }
    const double without = ll - l * l / n + squared_ink - ink * ink / n_ink;
    const auto explains = [&](double sum, double share) {
        return sum < square(share * (l / n - ink / n_ink)) * (n + n_ink);
    };
    // Half of the points lose their light behind an edge.
    if (!(n > 1 && n_ink > 1) || explains(without, kVisible / 2)) return std::nullopt;
    const auto plane = slope.solve({});
    if (!plane) return std::nullopt;
    const double turn = std::atan2(-plane->mean[2], -plane->mean[1]), c = std::cos(turn), s = std::sin(turn);
    double least = without / 2;
    std::optional<Light> best;
    // Beyond 0.9 outer radii lie 2 % of the disc.
    for (double at = kFirstWidth / 2 - 0.9; at < 0.9; at += kFirstWidth) {
        const auto shade = [&](const Point& p) {
            return std::clamp(0.5 + (c * p.x + s * p.y - at) / (4 * kFirstWidth), 0.0, 1.0);
        };
        double sh = 0, ss = 0, ls = 0;
        for (const Point& p : points) {
            if (p.is_ink) continue;
            const double dark = shade(p);
            sh += dark;
            ss += dark * dark;
            ls += p.level * dark;
        }
        const double paper = (ss * l - sh * ls) / (n * ss - sh * sh), loss = (paper * sh - ls) / (paper * ss);
        if (!(loss > kVisible)) continue;
        double g = 0, gg = 0;
        for (const Point& p : points) {
            if (!p.is_ink) continue;
            const double share = 1 - loss * shade(p);
            g += share * p.level;
            gg += share * share;
        }
        const double sum = ll - paper * (l - loss * ls) + squared_ink - g * g / gg;
        if (!(sum < least)) continue;
        least = sum;
        best = {paper, g / gg, loss, at, kFirstWidth, 0, turn};
    }
    // A trial that is half a step off leaves as much again.
    return explains(least, std::numbers::sqrt2 * kVisible) ? best : std::nullopt;
}

/// Gauss-Newton with Cauchy's weights; the scale of the residuals, infinite if it does not converge.
double refine(const std::vector<Point>& points, Light& q) {
    double scale = INFINITY;
    std::vector<LightAt> lit(points.size(), LightAt{});
    std::vector<double> off(points.size());
    for (int k = 0; k < kSteps; ++k) {
        const ShadowEdge light(q);
        for (size_t i = 0; i < points.size(); ++i) {
            const Point& p = points[i];
            lit[i] = light.at(p.x, p.y);
            off[i] = std::abs(p.level - q[p.is_ink ? kInk : kPaper] * lit[i].share);
        }
        const double before = scale;
        scale = std::max(1.0, 1.48 * median_of(off));
        if (k > 1 && scale > 0.99 * before) break;
        Regression<kUnknowns> system;
        for (size_t i = 0; i < points.size(); ++i) {
            const auto& [share, across, along, away, slope] = lit[i];
            const size_t ink = points[i].is_ink ? kInk : kPaper;
            const double level = q[ink], r = points[i].level - level * share, by = level * slope;
            Light J{};
            J[ink] = share;
            J[kLoss] = -level * (1 - share) / q[kLoss];
            J[kAt] = -by;
            J[kWidth] = -by * away / q[kWidth];
            J[kCurve] = by * square(along) / 2;
            J[kTurn] = by * (along - q[kCurve] * along * across);
            system.include(J, r, 1 / (square(scale) + square(r / 2)));
        }
        // Priors on the step: what an edge between two of the first trials may be off, and little curvature.
        const auto step = system.solve({0, 0, 10, 1, 10, 4, 1});
        if (!step) return INFINITY;
        for (size_t i = 0; i < kUnknowns; ++i) q[i] += step->mean[i];
        q[kWidth] = std::clamp(q[kWidth], 0.02, 1.0);
        if (!(std::abs(q[kAt]) < 2 && q[kLoss] > 0 && q[kLoss] < 0.95)) return INFINITY;
    }
    return scale;
}

}  // namespace

WithoutShadow::WithoutShadow(const ImageView& image, const InitialGuess& guess)
    : Surroundings(image, guess.outer, kCardReach * guess.outer.major), even_guess(in_view(guess)) {
    auto found = find_edge(read_points(image, guess, kFew));
    if (!found) return;
    const std::vector<Point> points = read_points(image, guess, kPixels);
    Light& q = *found;
    const double left = refine(points, q);
    if (!(left < kVisible * (q[kPaper] - q[kInk]) && q[kLoss] > kVisible)) return;
    const double a = guess.outer.major / 2;
    const ShadowEdge edge(q);
    double squared = 0;
    for (const Point& p : points) squared += 1 / square(edge.at(p.x, p.y).share);
    noise_gain = std::sqrt(squared / double(points.size()));
    levels_.resize(size_t(width_) * size_t(height_));
    for (int y = 0; y < height_; ++y)
        for (int x = 0; x < width_; ++x) {
            const double share =
                edge.at((left_ + x - guess.outer.x) / a, (top_ + y - guess.outer.y) / a).share;
            const double level = image.row(top_ + y)[left_ + x] / share;
            levels_[size_t(y) * size_t(width_) + size_t(x)] = uint8_t(std::lround(std::min(level, 255.0)));
        }
    even_guess.dark = q[kInk];
    even_guess.bright = std::min(255.0, q[kPaper]);
}

}  // namespace roundel
