// SPDX-License-Identifier: BSD-3-Clause
#include "code/code_reader.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>

#include "numeric/cholesky.hpp"

namespace roundel {

namespace {

constexpr double kTau = 2 * std::numbers::pi;
constexpr int kFinest = 16;                       // samples of a sector, at most
constexpr int kSamples = kCodeSectors * kFinest;  // of the ring, at most
constexpr int kHalf = kCodeSectors / 2;           // sectors whose costs one table adds up
constexpr double kMiddle = (kCodeInner + kCodeOuter) / 2;
constexpr double kMaxError = 1e-6;          // probability of a wrong name that counts as certain
constexpr double kCovered = 0.02;           // prior probability that something covers a sector
constexpr double kChanged = 1e-3;           // and that a track has become another roundel's
constexpr double kModelError = 0.1;         // of a sector's level, contrasts
constexpr double kRemembered = 10;          // frames of a mean: errors of fits differ from frame to frame
constexpr double kNegligible = -40;         // log-likelihoods that add less than 1e-15 to 1
constexpr double kInterpolation = 1 / 6.0;  // variance that bilinear interpolation adds to blur, px^2

/// The directions of all half samples, counter-clockwise as seen in front of the print.
struct Directions {
    std::array<double, 2 * kSamples> x, y;
    Directions() {
        for (size_t k = 0; k < x.size(); ++k) {
            x[k] = std::cos(kTau / 2 * double(k) / kSamples);
            y[k] = -std::sin(kTau / 2 * double(k) / kSamples);
        }
    }
};

/// All words at all turns: turn t of code n is at n kCodeSectors + t.
const std::vector<Word>& turned_words() {
    static const std::vector<Word> all = [] {
        std::vector<Word> words;
        for (const Word word : code_words())
            for (int turn = 0; turn < kCodeSectors; ++turn) words.push_back(turned(word, turn));
        return words;
    }();
    return all;
}

/// The grey level at a point; NaN outside of the image.
double level_at(const ImageView& image, double x, double y) {
    if (!(x >= 0 && y >= 0 && x < image.width - 1 && y < image.height - 1)) return NAN;
    const int u = int(x), v = int(y);
    const double a = x - u, b = y - v;
    const uint8_t *upper = image.row(v) + u, *lower = image.row(v + 1) + u;
    return (1 - b) * ((1 - a) * upper[0] + a * upper[1]) + b * ((1 - a) * lower[0] + a * lower[1]);
}

/// The ring of a code as a profile of blackness: 0 for paper, 1 for ink, at each sample of its middle.
struct Profile {
    int per_sector;                          // samples
    std::array<double, kSamples> black;      // NaN outside of the image
    std::array<double, kCodeSectors> gains;  // blackness per contrast, about each sector
    size_t size() const { return size_t(per_sector) * kCodeSectors; }
};

/// Samples about a pixel apart. Blur mixes ink with the paper on both sides of the ring, by an amount that
/// follows from the width of the ring's picture there.
Profile sample_ring(const ImageView& image, const Parameters& p) {
    static const Directions directions;
    const double radius = std::sqrt(std::abs(p[kAxx] * p[kAyy] - p[kAxy] * p[kAxy]));
    const double pixels = kTau * kMiddle * radius / kCodeSectors;
    Profile profile;
    profile.per_sector = pixels < 6 ? 4 : pixels < 12 ? 8 : kFinest;
    const size_t step = size_t(kFinest / profile.per_sector);
    const double det = p[kAxx] * p[kAyy] - p[kAxy] * p[kAxy], contrast = p[kBright] - p[kDark];
    const double spread = std::sqrt(2 * (p[kBlur] * p[kBlur] + kInterpolation));
    for (size_t k = 0; k < kCodeSectors; ++k) {
        const double x = directions.x[(2 * k + 1) * kFinest], y = directions.y[(2 * k + 1) * kFinest];
        const double per_pixel =
            std::hypot(p[kAyy] * x - p[kAxy] * y, p[kAxx] * y - p[kAxy] * x) / std::abs(det);
        profile.gains[k] = 1 / std::erf((kCodeOuter - kCodeInner) / 2 / per_pixel / spread);
    }
    for (size_t k = 0; k < profile.size(); ++k) {
        const double x = directions.x[(2 * k + 1) * step], y = directions.y[(2 * k + 1) * step];
        const double scale = kMiddle / (1 + kMiddle * (p[kGx] * x + p[kGy] * y));
        const double u = p[kAxx] * x + p[kAxy] * y, v = p[kAxy] * x + p[kAyy] * y;
        const double level = level_at(image, p[kX] + scale * u, p[kY] + scale * v);
        profile.black[k] = (p[kBright] - level) / contrast * profile.gains[k / size_t(profile.per_sector)];
    }
    return profile;
}

/// The blackness of the middle halves of the sectors that begin at a sample.
struct SectorLevels {
    int start;
    std::array<double, kCodeSectors> black;
};

/// Sectors at the start that separates ink from paper best.
SectorLevels find_sectors(const Profile& profile) {
    SectorLevels best{};
    double most = -1;
    const int m = profile.per_sector, n = int(profile.size());
    for (int start = 0; start < m; ++start) {
        SectorLevels at{start, {}};
        double apart = 0;
        for (int k = 0; k < kCodeSectors; ++k) {
            double black = 0;
            for (int j = m / 4; j < m - m / 4; ++j) black += profile.black[size_t((start + k * m + j) % n)];
            at.black[size_t(k)] = black / (m / 2);
            if (std::isfinite(black)) apart += square(std::clamp(at.black[size_t(k)], 0.0, 1.0) - 0.5);
        }
        if (apart > most) {
            most = apart;
            best = at;
        }
    }
    return best;
}

/// Sums of costs over the sectors of all parts of words of `kHalf` bits.
using Table = std::array<float, size_t(1) << kHalf>;

Table add_up(const float* white, const float* black) {
    Table table;
    table[0] = 0;
    for (size_t k = 0, n = 1; k < size_t(kHalf); ++k, n *= 2)
        for (size_t part = 0; part < n; ++part) {
            table[n + part] = table[part] + black[k];
            table[part] += white[k];
        }
    return table;
}

/// Log-likelihoods of a frame: of no code, and of any word by those of its halves.
struct FrameScores {
    float none = 0;
    Table low, high;
    float of(Word word) const { return low[word & (low.size() - 1)] + high[word >> kHalf]; }
    /// Of a code at its best turn.
    float of_code(size_t code) const {
        const Word* words = turned_words().data() + (code - 1) * kCodeSectors;
        float best = of(words[0]);
        for (int turn = 1; turn < kCodeSectors; ++turn) best = std::max(best, of(words[turn]));
        return best;
    }
    int turn_of(size_t code) const {
        const Word* words = turned_words().data() + (code - 1) * kCodeSectors;
        return int(
            std::max_element(words, words + kCodeSectors, [&](Word a, Word b) { return of(a) < of(b); }) -
            words);
    }
};

FrameScores score(const SectorLevels& sectors, const std::array<double, kCodeSectors>& gains, double noise) {
    std::array<float, kCodeSectors> white{}, black{};
    FrameScores frame;
    for (size_t k = 0; k < kCodeSectors; ++k) {
        if (!std::isfinite(sectors.black[k])) continue;
        const double variance = square(gains[k]) * (square(noise) + square(kModelError));
        const double peak = (1 - kCovered) / std::sqrt(kTau * variance);
        const double any = 1 / (2 * gains[k]);  // levels within half a contrast of ink and paper
        const auto log_likelihood = [&](double due) {
            const double error = square(sectors.black[k] - due) / variance;
            return float(std::log(peak * std::exp(-error / 2) + kCovered * any));
        };
        white[k] = log_likelihood(0);
        black[k] = log_likelihood(1);
        frame.none += float(std::log(any));
    }
    frame.low = add_up(white.data(), black.data());
    frame.high = add_up(white.data() + kHalf, black.data() + kHalf);
    return frame;
}

/// Adds a frame's log-likelihoods to the means of its track.
void add_frame(CodeEvidence& evidence, const FrameScores& frame, double prior) {
    std::vector<float>& means = evidence.means;
    const auto known = size_t(std::max_element(means.begin(), means.end()) - means.begin());
    const auto update = [&](size_t k, float now) { means[k] += float((now - means[k]) / evidence.count); };
    // Words differ so much that one which a frame alone proves excludes all others.
    if (known && frame.of_code(known) - frame.none > prior - std::log(kMaxError)) {
        evidence.count = std::min(evidence.count + 1, kRemembered);
        update(0, frame.none);
        update(known, frame.of_code(known));
        return;
    }
    std::vector<float> now{frame.none};
    for (size_t code = 1; code <= code_words().size(); ++code) now.push_back(frame.of_code(code));
    const float most = *std::max_element(now.begin(), now.end());
    // The track may have become another roundel's.
    if (means.empty() || most - now[known] > prior - std::log(kChanged)) {
        means.assign(now.size(), 0);
        evidence.count = 0;
    }
    evidence.count = std::min(evidence.count + 1, kRemembered);
    for (size_t k = 0; k < now.size(); ++k) update(k, now[k]);
}

/// The angle from the first sample's side to the zero of a word, and its variance, radians.
struct Zero {
    double angle, variance;
};

/// Least squares over the edges between ink and paper. Unknowns: an error of the levels, which displaces both
/// kinds of edges in opposite directions; the displacement of the ring's centre, of which the fit has the
/// variance `centre` in radians of the ring; the lateness of the zero. Lengths are in samples.
Zero find_zero(const Profile& profile, const SectorLevels& sectors, Word seen, int turn, double noise,
               double centre) {
    constexpr int kUnknowns = 4;
    const int m = profile.per_sector, n = int(profile.size());
    const double step = kTau / n, prior = m * square(noise) * square(step) / centre;
    std::array<Vector<kUnknowns>, kUnknowns> H{};
    Vector<kUnknowns> right{};
    double squares = 0, gain = 0;
    int edges = 0;
    H[1][1] = H[2][2] = prior;
    for (int k = 0; k < kCodeSectors; ++k) {
        const bool before = seen >> k & 1, after = seen >> ((k + 1) % kCodeSectors) & 1;
        if (before == after) continue;
        double black = 0;
        const int middle = sectors.start + k * m + m / 2;
        for (int j = 0; j < m; ++j) black += profile.black[size_t((middle + j) % n)];
        if (!std::isfinite(black)) continue;
        const double late = before ? black - m / 2.0 : m / 2.0 - black;
        const double angle = step * (middle + m / 2.0);
        const Vector<kUnknowns> J{before ? 1.0 : -1.0, std::cos(angle), std::sin(angle), 1};
        for (size_t i = 0; i < kUnknowns; ++i) {
            right[i] += J[i] * late;
            for (size_t j = 0; j <= i; ++j) H[i][j] += J[i] * J[j];
        }
        squares += late * late;
        gain += square(profile.gains[size_t(k)]);
        ++edges;
    }
    const Cholesky<kUnknowns> factor(H);
    if (!factor.positive()) return {0, INFINITY};
    const Vector<kUnknowns> x = factor.solve(right);
    for (size_t i = 0; i < kUnknowns; ++i) squares -= right[i] * x[i];
    // Both edges of an arc are wrong together where compression or blur displaces it: they count as one.
    const double variance =
        2 * std::max(m * square(noise) * gain / edges, squares / std::max(1, edges - kUnknowns));
    return {step * (sectors.start + turn * m + x[3]),
            square(step) * variance * factor.inverse_tail<1>()[0][0]};
}

/// The place on the outer ellipse of the point of the outer circle at an angle.
double on_ellipse(const Parameters& p, double angle) {
    const double x = std::cos(angle), y = -std::sin(angle), depth = 1 + p[kGx] * x + p[kGy] * y;
    const CircleImage outer = circle_image(p, 1);
    const double u = p[kX] + (p[kAxx] * x + p[kAxy] * y) / depth - outer.x;
    const double v = p[kY] + (p[kAxy] * x + p[kAyy] * y) / depth - outer.y;
    const double root =
        std::sqrt(outer.shape.det());  // S^(-1/2) is S + root I with its rows exchanged, scaled
    const double sxx = outer.shape.xx + root, syy = outer.shape.yy + root;
    return std::atan2(sxx * v - outer.shape.xy * u, syy * u - outer.shape.xy * v);
}

}  // namespace

CodeReading CodeTrack::add(const ImageView& image, const RoundelFit& fit) {
    const double contrast = fit.p[kBright] - fit.p[kDark];
    const Profile profile = sample_ring(image, fit.p);
    const SectorLevels sectors = find_sectors(profile);
    const double noise = std::max(1.0, fit.noise) / contrast;
    const FrameScores frame = score(sectors, profile.gains, noise);
    const double rho = square(kModelError) / (square(kModelError) + square(noise));
    const size_t n_codes = code_words().size();
    const double prior = std::log(double(n_codes) * kCodeSectors);
    add_frame(evidence_, frame, prior);

    // No code is as probable as any code at any turn.
    const std::vector<float>& means = evidence_.means;
    const double frames = evidence_.count / (1 + (evidence_.count - 1) * rho);
    const auto best = std::max_element(means.begin() + 1, means.end()) - means.begin();
    const double top = means[size_t(best)];
    double others = std::exp(std::min(frames * (means[0] - top) + prior, 700.0));
    for (size_t k = 1; k < means.size(); ++k) {
        const double below = frames * (means[k] - top);
        if (k != size_t(best) && below > kNegligible) others += std::exp(below);
    }
    if (!(others < kMaxError)) return {};
    if (frame.of_code(size_t(best)) < frame.none) return {int(best), 1 / (1 + others), NAN, NAN};  // covered
    // The fit measures the offset of the disc's centre; that of the ring's centre is as large relative to it.
    const Symmetric offset = fit.offset_covariance();
    const double centre = (offset.xx + offset.yy) / (2 * fit.outer.major * fit.outer.minor / 4) *
                          square((square(kMiddle) - 1) / kMiddle);
    const int turn = frame.turn_of(size_t(best));
    const Word seen = turned(code_words()[size_t(best - 1)], turn);
    const Zero zero = find_zero(profile, sectors, seen, turn, noise, centre);
    return {int(best), 1 / (1 + others), on_ellipse(fit.p, zero.angle), std::sqrt(zero.variance)};
}

}  // namespace roundel
