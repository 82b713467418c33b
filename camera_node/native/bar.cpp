// SPDX-License-Identifier: BSD-3-Clause
#include "bar.hpp"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <numbers>
#include <vector>

#include "sector_view.hpp"

namespace roundel {

namespace {

constexpr double kInk = 0.12, kStillInk = 0.2, kNoInk = 0.3;  // of the contrast
constexpr double kOfHole[] = {0.2, 0.5, 0.8};                 // radii that are looked at, of the hole's, and
constexpr double kOfCard[] = {1.12, 1.2};                     // outside, of the disc's
constexpr double kBeyond[] = {1.12, 1.2, 1.3, 1.4, 1.5};      // where it goes on
constexpr int kAngles = 64;                                   // of half a turn
constexpr double kWidest = 0.8, kOutermost = 0.85;            // outer radii
constexpr double kEdge = 0.2;                                 // likewise, of the bar's blurred edges
constexpr double kBlurred = 0.05;             // likewise, of what its edges may show within it
constexpr double kOther = 0.03, kSure = 3.5;  // of the contrast and of the noise: not the ring's level
constexpr double kWide = 3;                   // spreads of a blurred edge
constexpr size_t kLeastPoints = 4;

struct Point {
    double x, y;
    double along(double angle) const { return x * std::cos(angle) + y * std::sin(angle); }
};

double angle_of(int sector) { return (sector + 0.5) * 2 * std::numbers::pi / kSectors; }

/// Where ink is seen that is none of a roundel's, and where there is none.
struct Points {
    std::vector<Point> ink, none;
    void add(const SectorView& view, double radius) {
        for (int s = 0; s < kSectors; ++s) {
            const Point point{radius * std::cos(angle_of(s)), radius * std::sin(angle_of(s))};
            const double level = view.at(point.x, point.y);
            if (level < kInk) ink.push_back(point);
            if (level > kNoInk) none.push_back(point);
        }
    }
};

Bar strip_around(const std::vector<Point>& points, double angle) {
    Bar bar{angle, 1e9, -1e9};
    for (const Point& point : points) {
        const double along = point.along(angle);
        bar.from = std::min(bar.from, along), bar.to = std::max(bar.to, along);
    }
    return bar;
}

/// Whether it covers more than the rim, and not all.
bool is_deep(const Bar& bar) {
    return bar.to - bar.from < kWidest && bar.from < kOutermost && bar.to > -kOutermost;
}

/// Whether a point lies in it.
bool contradict(const std::vector<Point>& points, const Bar& bar) {
    return std::any_of(points.begin(), points.end(), [&](const Point& point) {
        const double along = point.along(bar.angle);
        return along > bar.from + kBlurred && along < bar.to - kBlurred;
    });
}

/// The mean level along its middle, on either side as far as it is looked at; nothing where it ends before.
std::optional<double> level_beyond(const SectorView& view, const Bar& bar) {
    const double middle = (bar.from + bar.to) / 2, c = std::cos(bar.angle), s = std::sin(bar.angle);
    double sum = 0;
    for (const double radius : kBeyond)
        for (const double side : {-1.0, 1.0}) {
            const double across = side * std::sqrt(radius * radius - middle * middle);
            const double level = view.at(middle * c - across * s, middle * s + across * c);
            if (level > kStillInk) return std::nullopt;
            sum += level;
        }
    return sum / double(2 * std::size(kBeyond));
}

/// Whether a bar's level is not the ring's own. A stroke that blur makes brighter has none.
bool is_other_ink(const Bar& bar, double level, const Fit& fit, double noise) {
    const double chance = kSure * noise / (fit.bright - fit.dark) / std::sqrt(2 * std::size(kBeyond));
    const bool is_wide = (bar.to - bar.from) * fit.outer.minor / 2 > kWide * fit.blur;
    return (is_wide ? std::abs(level) : -level) > std::max(kOther, chance);
}

}  // namespace

Sectors Bar::hides(double radius) const {
    Sectors hidden = 0;
    for (int s = 0; s < kSectors; ++s) {
        const double along = radius * std::cos(angle_of(s) - angle);
        hidden |= Sectors(along > from - kEdge && along < to + kEdge) << s;
    }
    return hidden;
}

std::optional<Bar> find_bar(const ImageView& image, const Fit& fit, double noise) {
    const SectorView view(image, fit);
    Points points;
    for (const double share : kOfHole) points.add(view, share * fit.ratio);
    for (const double radius : kOfCard) points.add(view, radius);
    if (points.ink.size() < kLeastPoints) return std::nullopt;
    std::optional<Bar> best;
    double least = kStillInk;
    for (int k = 0; k < kAngles; ++k) {
        const Bar bar = strip_around(points.ink, k * std::numbers::pi / kAngles);
        if (!is_deep(bar) || contradict(points.none, bar)) continue;
        if (const auto level = level_beyond(view, bar); level && *level < least) least = *level, best = bar;
    }
    return best && is_other_ink(*best, least, fit, noise) ? best : std::nullopt;
}

}  // namespace roundel
