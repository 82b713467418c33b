// SPDX-License-Identifier: BSD-3-Clause
#include "blur/streaks.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

#include "numeric/cholesky.hpp"
#include "numeric/ray.hpp"
#include "numeric/simd.hpp"

namespace roundel {

namespace {

constexpr double kLengths[] = {0.25, 0.4, 0.55, 0.75, 1};  // of the motion, diameters
constexpr int kInstants = 16;                              // of the exposure
constexpr double kReachAlong = 2, kReachAcross = 1.2;      // of the points, radii
constexpr double kSeeThrough = 30;              // variance of the ground over that of what is no roundel
constexpr double kFirst = 0.4;                  // misfit over the contrast in the streak's own direction,
constexpr double kNear = 0.25;                  // in any, from which the descent begins,
constexpr double kNears[] = {0.2, 0.13, 0.09};  // and after each of its rounds
constexpr double kFirstStep = 0.1, kNextStep = 0.6;  // of the width; of the step before
constexpr double kTurn = 1.5;                        // radians of a step of one width
constexpr double kTurns[] = {0, -0.25, 0.25};        // radians off the streak's direction
constexpr float kUnlike = 1.2f;                      // of the contrast, between points that are alike

/// Position of point `k` of `count` in a row.
constexpr double spread(int k, int count, double reach) { return reach * (k - count / 2) / (count / 2); }

/// Whether hole and bars are alike on both sides of the middle, and the hole brighter.
bool is_symmetric(const ImageView& image, const Streak& s, float min_contrast) {
    constexpr float points[][2] = {{0.35f, 0},    {-0.35f, 0},   {0.3f, 0.8f},
                                   {-0.3f, 0.8f}, {0.3f, -0.8f}, {-0.3f, -0.8f}};
    float level[6];
    for (int k = 0; k < 6; ++k) {
        const float a = points[k][0] * s.width / 2, b = points[k][1] * s.width / 2;
        level[k] = sample(image, s.x + a * s.along_x - b * s.along_y, s.y + a * s.along_y + b * s.along_x);
        if (level[k] < 0) return false;
    }
    const auto [hole, other] = std::minmax(level[0], level[1]);
    const auto [least, most] = std::minmax_element(level + 2, level + 6);
    const float contrast = (hole + other) / 2 - (level[2] + level[3] + level[4] + level[5]) / 4;
    return contrast > min_contrast && other - hole < kUnlike * contrast &&
           *most - *least < kUnlike * contrast;
}

}  // namespace

StreakMatcher::StreakMatcher(const Settings& settings) : min_contrast_(float(settings.min_contrast)) {
    for (const double ratio : settings.inner_ratios)
        for (const double length : kLengths) appearances_.push_back(make_appearance(ratio, length));
}

StreakMatcher::Appearance StreakMatcher::make_appearance(double ratio, double length) {
    Appearance to{ratio, length, {}, {}, {}};
    std::array<Vector<3>, 3> H{};
    float weights = 0;
    for (size_t k = 0; k < kPoints; ++k) {
        const double s = spread(int(k) % kAlong, kAlong, kReachAlong);
        const double n = spread(int(k) / kAlong, kAcross, kReachAcross);
        Vector<3> share{};  // of paper, ink and ground
        for (int j = 0; j < kInstants; ++j) {
            const double along = s - 2 * length * ((j + 0.5) / kInstants - 0.5), rr = along * along + n * n;
            share[rr > kCardRatio * kCardRatio ? 2 : rr < 1 && rr > ratio * ratio] += 1.0 / kInstants;
        }
        const double weight = 1 / (1 + kSeeThrough * share[2] * share[2]);
        for (size_t i = 0; i < 3; ++i) {
            to.share[i].at[k] = float(share[i]);
            for (size_t j = 0; j < 3; ++j) H[i][j] += weight * share[i] * share[j];
        }
        to.weight.at[k] = float(weight), weights += float(weight);
    }
    for (size_t i = 0; i < 3; ++i) H[i][i] += 1e-3;  // short motions leave some levels unseen
    const Cholesky<3> factor(H);
    for (size_t k = 0; k < kPoints; ++k) {
        const double w = double(to.weight.at[k]);
        const auto solved = factor.solve(
            {w * double(to.share[0].at[k]), w * double(to.share[1].at[k]), w * double(to.share[2].at[k])});
        for (size_t i = 0; i < 3; ++i) to.solve[i].at[k] = float(solved[i]);
        to.weight.at[k] /= weights;
    }
    return to;
}

/// Beyond the image's edge its last pixels are seen.
void StreakMatcher::sample(const ImageView& image, const Place& p, Column& levels) {
    const auto c = float(std::cos(p.angle)), s = float(std::sin(p.angle));
    const auto along = float(kReachAlong / (kAlong / 2) * p.along / 2);
    const auto across = float(kReachAcross / (kAcross / 2) * p.across / 2);
    const auto right = float(image.width - 1), bottom = float(image.height - 1);
    for (int j = 0, k = 0; j < kAcross; ++j)
        for (int i = 0; i < kAlong; ++i, ++k) {
            const float a = along * float(i - kAlong / 2), b = across * float(j - kAcross / 2);
            const float x = std::clamp(float(p.x) + a * c - b * s + 0.5f, 0.0f, right);
            const float y = std::clamp(float(p.y) + a * s + b * c + 0.5f, 0.0f, bottom);
            levels.at[size_t(k)] = float(image.row(int(y))[int(x)]);
        }
}

/// With every `stride`-th appearance.
ROUNDEL_CLONES void StreakMatcher::compare(const Column& levels, const Place& place, size_t stride,
                                           Match& best) const {
    for (size_t n = stride - 1; n < appearances_.size(); n += stride) {
        const Appearance& seen = appearances_[n];
        Lanes sums[3] = {}, squares = {};
        for (size_t k = 0; k < kPadded; k += kLanes)
            for (size_t i = 0; i < 3; ++i) sums[i] += load(&seen.solve[i].at[k]) * load(&levels.at[k]);
        const float paper = sum(sums[0]), ink = sum(sums[1]), ground = sum(sums[2]), contrast = paper - ink;
        if (contrast < min_contrast_) continue;
        for (size_t k = 0; k < kPadded; k += kLanes) {
            const Lanes off = load(&levels.at[k]) - paper * load(&seen.share[0].at[k]) -
                              ink * load(&seen.share[1].at[k]) - ground * load(&seen.share[2].at[k]);
            squares += load(&seen.weight.at[k]) * off * off;
        }
        const double misfit = std::sqrt(double(sum(squares))) / double(contrast);
        if (misfit < best.misfit) best = {place, &seen, misfit, double(ink), double(paper)};
    }
}

bool StreakMatcher::descend(const ImageView& image, Match& best) const {
    Column levels;
    double step = kFirstStep;
    const double width = best.place.across;
    for (const double near : kNears) {
        for (double Place::* member : {&Place::along, &Place::across, &Place::angle, &Place::x, &Place::y})
            for (const double sign : {-1, 1}) {
                Place place = best.place;
                place.*member += sign * step * (member == &Place::angle ? kTurn : width);
                sample(image, place, levels);
                compare(levels, place, 1, best);
            }
        if (best.misfit > near) return false;
        step *= kNextStep;
    }
    return true;
}

std::optional<SmearedStart> StreakMatcher::match(const ImageView& image, const Streak& s) const {
    if (!is_symmetric(image, s, min_contrast_ / 2)) return std::nullopt;
    Match best{{}, nullptr, kFirst, 0, 0};
    Column levels;
    const double width = double(s.width), angle = std::atan2(double(s.along_y), double(s.along_x));
    for (const double turn : kTurns) {
        const Place place{double(s.x), double(s.y), angle + turn, width, width};
        sample(image, place, levels);
        compare(levels, place, 2, best);
        if (!best.appearance) return std::nullopt;
    }
    if (best.misfit > kNear || !descend(image, best)) return std::nullopt;
    const Place& p = best.place;
    const auto [minor, major] = std::minmax(p.along, p.across);
    const Ellipse outer{p.x, p.y, major, minor, p.angle + (p.across > p.along ? std::numbers::pi / 2 : 0)};
    const double length = best.appearance->length * p.along;
    const Start still{outer, best.appearance->ratio, best.dark, best.bright};
    return SmearedStart{{still, length * std::cos(p.angle), length * std::sin(p.angle)}, best.misfit};
}

}  // namespace roundel
