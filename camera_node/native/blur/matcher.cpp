// SPDX-License-Identifier: BSD-3-Clause
#include "blur/matcher.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

#include "numeric/ray.hpp"
#include "numeric/simd.hpp"

namespace roundel {

namespace {

// Known roundels.
constexpr double kStepsPerMinor = 7;  // steps of the grid of positions over the minor axis
constexpr size_t kMaxMatches = 3;
constexpr double kMaxKnownMisfit = 0.3;  // RMS over the contrast
constexpr double kMinDistance = 0.3;     // minor axes between two matches

// New roundels.
constexpr double kLengths[] = {0.25, 0.4, 0.55, 0.75, 1};  // of the motion, diameters
constexpr double kNeighbour = 1.65;       // factor between two neighbours of these lengths at most
constexpr double kMaxFirstMisfit = 0.4;   // RMS over the contrast in the direction of the streak,
constexpr double kMaxStartMisfit = 0.25;  // in the best direction, before the descent,
// and after each of its rounds. Templates are not blurred and have five lengths: true matches reach 0.11.
constexpr double kMaxMisfits[] = {0.2, 0.15, 0.13, 0.11};
constexpr double kFirstStep = 0.1;             // widths
constexpr double kNextStep = 0.6;              // factor from round to round
constexpr double kRadians = 1.5;               // of a step of one width
constexpr double kTurns[] = {0, -0.25, 0.25};  // radians from the streak's direction
constexpr float kMaxAsymmetry = 1.2f;          // of the contrast, between symmetric points

/// The nearest pixels of a template's points; false if one is outside of the image.
bool sample_known(const ImageView& image, const KnownTemplates& templates, double x, double y,
                  KnownTemplate::Levels& levels) {
    for (size_t k = 0; k < levels.size(); ++k) {
        const DiscPoint& at = templates.points()[k];
        const int u = int(std::lround(x + at.x)), v = int(std::lround(y + at.y));
        if (u < 0 || v < 0 || u >= image.width || v >= image.height) return false;
        levels[k] = float(image.row(v)[u]);
    }
    return true;
}

/// A position of a known roundel and the template that fits best there.
struct KnownMatch {
    double x, y;
    const KnownTemplate* motion;
    float misfit;  // mean squared residual
};

KnownMatch best_template(const KnownTemplate::Levels& levels, const KnownTemplates& templates, double x,
                         double y) {
    KnownMatch best{x, y, nullptr, 1e9f};
    for (const KnownTemplate& t : templates.all())
        if (const float m = t.misfit(levels); m < best.misfit) {
            best.motion = &t;
            best.misfit = m;
        }
    return best;
}

/// Non-maximum suppression: the best matches, each at least `distance` from better ones.
std::vector<KnownMatch> pick(std::vector<KnownMatch> matches, double distance) {
    std::sort(matches.begin(), matches.end(),
              [](const KnownMatch& a, const KnownMatch& b) { return a.misfit < b.misfit; });
    std::vector<KnownMatch> picked;
    for (const KnownMatch& p : matches) {
        const auto is_near = [&](const KnownMatch& q) { return std::hypot(p.x - q.x, p.y - q.y) < distance; };
        if (picked.size() == kMaxMatches) break;
        if (std::none_of(picked.begin(), picked.end(), is_near)) picked.push_back(p);
    }
    return picked;
}

/// Whether hole and bars are similar on both sides of the centre, and the hole is brighter.
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
    return contrast > min_contrast && other - hole < kMaxAsymmetry * contrast &&
           *most - *least < kMaxAsymmetry * contrast;
}

/// The points of a new roundel's templates, in steps from the middle along and across the motion.
struct TemplateGrid {
    std::array<float, NewTemplate::kPadded> along{}, across{};
};
constexpr TemplateGrid kTemplateGrid = [] {
    TemplateGrid grid;
    for (int k = 0; k < NewTemplate::kPoints; ++k) {
        grid.along[size_t(k)] = float(k % NewTemplate::kAlong - NewTemplate::kAlong / 2);
        grid.across[size_t(k)] = float(k / NewTemplate::kAlong - NewTemplate::kAcross / 2);
    }
    return grid;
}();

}  // namespace

void MotionBlurMatcher::use_prints(std::span<const Print> prints) {
    constexpr size_t kOfPrint = std::size(kLengths);
    const auto is_same = [&](size_t k) { return templates_[k * kOfPrint].ratio == prints[k].ratio; };
    size_t same = 0;
    while (same < std::min(prints.size(), templates_.size() / kOfPrint) && is_same(same)) ++same;
    templates_.erase(templates_.begin() + std::ptrdiff_t(same * kOfPrint), templates_.end());
    for (const Print& print : prints.subspan(same))
        for (const double length : kLengths) templates_.emplace_back(print.ratio, length);
}

std::vector<MovingMatch> MotionBlurMatcher::match_known(const ImageView& image, const InitialGuess& predicted,
                                                        double reach) {
    const KnownTemplates templates(predicted);
    const double contrast = predicted.bright - predicted.dark, unlike = kMaxKnownMisfit * contrast;
    const double step = predicted.outer.minor / kStepsPerMinor;
    const int steps = int(reach / step);
    std::vector<KnownMatch> found;
    KnownTemplate::Levels levels;
    for (int j = -steps; j <= steps; ++j)
        for (int k = -steps; k <= steps; ++k) {
            const double x = predicted.outer.x + k * step, y = predicted.outer.y + j * step;
            if (!sample_known(image, templates, x, y, levels)) continue;
            const KnownMatch match = best_template(levels, templates, x, y);
            if (match.misfit < unlike * unlike) found.push_back(match);
        }
    std::vector<MovingMatch> matches;
    for (const KnownMatch& m : pick(std::move(found), kMinDistance * predicted.outer.minor)) {
        MovingGuess guess{predicted, m.motion->motion_x, m.motion->motion_y};
        guess.still.outer.x = m.x;
        guess.still.outer.y = m.y;
        matches.push_back({guess, std::sqrt(std::max(0.0, double(m.misfit))) / contrast});
    }
    return matches;
}

/// Nearest pixels; the image's border is repeated.
ROUNDEL_CLONES void MotionBlurMatcher::sample(const ImageView& image, const DiscPlace& p,
                                              NewTemplate::Column& levels) {
    const auto c = float(std::cos(p.angle)), s = float(std::sin(p.angle));
    const auto along = float(NewTemplate::kReachAlong / (NewTemplate::kAlong / 2) * p.along / 2);
    const auto across = float(NewTemplate::kReachAcross / (NewTemplate::kAcross / 2) * p.across / 2);
    const Lanes right = all(float(image.width - 1)), bottom = all(float(image.height - 1));
    for (size_t k = 0; k < NewTemplate::kPadded; k += kLanes) {
        const Lanes a = along * load(&kTemplateGrid.along[k]), b = across * load(&kTemplateGrid.across[k]);
        const Lanes x = clamped(float(p.x) + a * c - b * s + 0.5f, all(0), right);
        const Lanes y = clamped(float(p.y) + a * s + b * c + 0.5f, all(0), bottom);
        const Bits column = __builtin_convertvector(x, Bits), row = __builtin_convertvector(y, Bits);
        for (int n = 0; n < kLanes; ++n) levels.at[k + size_t(n)] = float(image.row(row[n])[column[n]]);
    }
}

/// Replaces the best match by better ones among the selected templates.
ROUNDEL_CLONES void MotionBlurMatcher::compare(const NewTemplate::Column& levels, const DiscPlace& place,
                                               const Selection& among, StreakMatch& best) const {
    constexpr size_t kPadded = NewTemplate::kPadded;
    for (size_t n = among.stride - 1; n < templates_.size(); n += among.stride) {
        const NewTemplate& t = templates_[n];
        if (t.length < among.shortest || t.length > among.longest) continue;
        Lanes sums[3] = {}, squares = {};
        for (size_t k = 0; k < kPadded; k += kLanes)
            for (size_t i = 0; i < 3; ++i) sums[i] += load(&t.solve[i].at[k]) * load(&levels.at[k]);
        const float paper = sum(sums[0]), ink = sum(sums[1]), ground = sum(sums[2]), contrast = paper - ink;
        if (contrast < min_contrast_) continue;
        for (size_t k = 0; k < kPadded; k += kLanes) {
            const Lanes off = load(&levels.at[k]) - paper * load(&t.share[0].at[k]) -
                              ink * load(&t.share[1].at[k]) - ground * load(&t.share[2].at[k]);
            squares += load(&t.weight.at[k]) * off * off;
        }
        const double misfit = std::sqrt(double(sum(squares))) / double(contrast);
        if (misfit < best.misfit) best = {place, &t, misfit, double(ink), double(paper)};
    }
}

/// Coordinate descent with decreasing steps; false if a round does not reach its misfit.
bool MotionBlurMatcher::descend(const ImageView& image, StreakMatch& best) const {
    NewTemplate::Column levels;
    double step = kFirstStep;
    const double width = best.place.across;
    for (const double max_misfit : kMaxMisfits) {
        for (double DiscPlace::* member :
             {&DiscPlace::along, &DiscPlace::across, &DiscPlace::angle, &DiscPlace::x, &DiscPlace::y})
            for (const double sign : {-1, 1}) {
                DiscPlace place = best.place;
                place.*member += sign * step * (member == &DiscPlace::angle ? kRadians : width);
                sample(image, place, levels);
                const double length = best.found->length;
                compare(levels, place, {1, length / kNeighbour, length * kNeighbour}, best);
            }
        if (best.misfit > max_misfit) return false;
        step *= kNextStep;
    }
    return true;
}

std::optional<MovingMatch> MotionBlurMatcher::match_streak(const ImageView& image, const Streak& s) const {
    if (!is_symmetric(image, s, min_contrast_ / 2)) return std::nullopt;
    StreakMatch best{{}, nullptr, kMaxFirstMisfit, 0, 0};
    NewTemplate::Column levels;
    const double width = double(s.width), angle = std::atan2(double(s.along_y), double(s.along_x));
    for (const double turn : kTurns) {
        const DiscPlace place{double(s.x), double(s.y), angle + turn, width, width};
        sample(image, place, levels);
        compare(levels, place, {2, 0, INFINITY}, best);
        if (!best.found) return std::nullopt;
    }
    if (best.misfit > kMaxStartMisfit || !descend(image, best)) return std::nullopt;
    const DiscPlace& p = best.place;
    const auto [minor, major] = std::minmax(p.along, p.across);
    const Ellipse outer{p.x, p.y, major, minor, p.angle + (p.across > p.along ? std::numbers::pi / 2 : 0)};
    const double length = best.found->length * p.along;
    const InitialGuess still{outer, best.found->ratio, best.dark, best.bright};
    return MovingMatch{{still, length * std::cos(p.angle), length * std::sin(p.angle)}, best.misfit};
}

}  // namespace roundel
