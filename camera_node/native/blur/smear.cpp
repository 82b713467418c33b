// SPDX-License-Identifier: BSD-3-Clause
#include "blur/smear.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>

namespace roundel {

namespace {

constexpr int kSide = 7;                     // of the grid of points
constexpr int kPoints = kSide * kSide - 12;  // without its corners
constexpr double kExtent = 1.15;             // of the grid, outer radii
constexpr int kInstants = 12;                // of the exposure
constexpr int kDirections = 6;
constexpr double kLengths[] = {0.35, 0.7};  // of the motion, diameters
constexpr double kSteps = 7;                // to a minor axis
constexpr int kMost = 3;                    // places to be fitted
constexpr double kUnlike = 0.3;             // of the contrast: RMS of what is no roundel
constexpr double kApart = 0.3;              // of the minor axis, from one place to the next

struct Point {
    double x, y;
};

/// Points of the disc, in outer radii.
std::array<Point, kPoints> make_grid() {
    std::array<Point, kPoints> grid;
    constexpr int middle = kSide / 2;
    size_t n = 0;
    for (int j = -middle; j <= middle; ++j)
        for (int k = -middle; k <= middle; ++k)
            if (std::abs(j) + std::abs(k) < 2 * middle - 1)
                grid[n++] = {kExtent * k / middle, kExtent * j / middle};
    return grid;
}

/// How a motion looks at the points: the level without ground, and the share of the exposure that saw the
/// ground.
struct Template {
    double motion_x, motion_y;  // pixels
    std::array<float, kPoints> level, ground;
    float ground_ground;
};

/// Where the points are in the picture, from the centre, pixels; and what may be seen there.
class Appearance {
  public:
    explicit Appearance(const Fit& fit)
        : fit_(fit), c_(std::cos(fit.outer.angle)), s_(std::sin(fit.outer.angle)) {
        for (const Point& p : make_grid()) {
            const double along = p.x * fit.outer.major / 2, across = p.y * fit.outer.minor / 2;
            at.push_back({c_ * along - s_ * across, s_ * along + c_ * across});
        }
        const double diameter = std::sqrt(fit.outer.major * fit.outer.minor);
        for (int k = 0; k < kDirections; ++k)
            for (const double length : kLengths) {
                const double angle = std::numbers::pi * k / kDirections;
                templates.push_back(
                    smear(length * diameter * std::cos(angle), length * diameter * std::sin(angle)));
            }
    }
    std::vector<Point> at;
    std::vector<Template> templates;

  private:
    Template smear(double x, double y) const {
        Template t{x, y, {}, {}, 1e-6f};
        for (size_t k = 0; k < kPoints; ++k) {
            double dark = 0, ground = 0;
            for (int n = 0; n < kInstants; ++n) {
                const double share = (n + 0.5) / kInstants - 0.5,
                             r = radius(at[k].x - share * x, at[k].y - share * y);
                dark += r < 1 && r > fit_.ratio, ground += r > kCardRatio;
            }
            t.level[k] = float(fit_.bright + (fit_.dark - fit_.bright) * dark / kInstants);
            t.ground[k] = float(ground / kInstants), t.ground_ground += t.ground[k] * t.ground[k];
        }
        return t;
    }
    double radius(double x, double y) const {
        return std::hypot((c_ * x + s_ * y) / fit_.outer.major, (c_ * y - s_ * x) / fit_.outer.minor) * 2;
    }
    const Fit& fit_;
    double c_, s_;
};

using Levels = std::array<float, kPoints>;

bool sample(const ImageView& image, const std::vector<Point>& at, double x, double y, Levels& levels) {
    for (size_t k = 0; k < kPoints; ++k) {
        const int u = int(std::lround(x + at[k].x)), v = int(std::lround(y + at[k].y));
        if (u < 0 || v < 0 || u >= image.width || v >= image.height) return false;
        levels[k] = float(image.row(v)[u]);
    }
    return true;
}

/// Mean squared difference, of the best level of the ground.
float misfit(const Levels& levels, const Template& t) {
    float squares = 0, ground = 0;
    for (size_t k = 0; k < kPoints; ++k) {
        const float off = levels[k] - t.level[k];
        squares += off * off, ground += off * t.ground[k];
    }
    return (squares - ground * ground / t.ground_ground) / kPoints;
}

struct Place {
    double x, y;
    const Template* motion;
    float misfit;
};

/// The template that fits best at a place.
Place match(const Levels& levels, const Appearance& seen, double x, double y) {
    Place best{x, y, nullptr, 1e9f};
    for (const Template& t : seen.templates)
        if (const float m = misfit(levels, t); m < best.misfit) best.motion = &t, best.misfit = m;
    return best;
}

/// The best places, each some way from those before it.
std::vector<Place> pick(std::vector<Place> places, double apart) {
    std::sort(places.begin(), places.end(),
              [](const Place& a, const Place& b) { return a.misfit < b.misfit; });
    std::vector<Place> picked;
    for (const Place& p : places) {
        const auto near = [&](const Place& q) { return std::hypot(p.x - q.x, p.y - q.y) < apart; };
        if (picked.size() == kMost) break;
        if (std::none_of(picked.begin(), picked.end(), near)) picked.push_back(p);
    }
    return picked;
}

}  // namespace

std::vector<MovingStart> search_smeared(const ImageView& image, const Fit& last, double x, double y,
                                        double reach) {
    const Appearance seen(last);
    const double step = last.outer.minor / kSteps, unlike = kUnlike * (last.bright - last.dark);
    const int steps = int(reach / step);
    std::vector<Place> places;
    Levels levels;
    for (int j = -steps; j <= steps; ++j)
        for (int k = -steps; k <= steps; ++k) {
            if (!sample(image, seen.at, x + k * step, y + j * step, levels)) continue;
            const Place place = match(levels, seen, x + k * step, y + j * step);
            if (place.misfit < unlike * unlike) places.push_back(place);
        }
    std::vector<MovingStart> starts;
    for (const Place& p : pick(std::move(places), kApart * last.outer.minor)) {
        MovingStart start{
            {last.outer, last.ratio, last.dark, last.bright}, p.motion->motion_x, p.motion->motion_y};
        start.still.outer.x = p.x, start.still.outer.y = p.y;
        starts.push_back(start);
    }
    return starts;
}

}  // namespace roundel
