// SPDX-License-Identifier: BSD-3-Clause
#include "code/code_reader.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <numbers>
#include <utility>

#include "numeric/cholesky.hpp"
#include "numeric/lanes.hpp"
#include "numeric/simd.hpp"

namespace roundel {

namespace {

constexpr double kTau = 2 * std::numbers::pi;
constexpr int kFinest = 16;                                    // samples of a sector, at most
constexpr int kPadded = (kCodeSectors / kLanes + 1) * kLanes;  // sectors in whole lanes
constexpr double kMiddle = (kCodeInner + kCodeOuter) / 2;
constexpr double kMaxError = 1e-6;          // probability of a wrong name that counts as certain
constexpr double kCovered = 0.02;           // prior probability that something covers a sector
constexpr double kChanged = 1e-3;           // and that a track has become another roundel's
constexpr double kModelError = 0.1;         // of a sector's level, contrasts
constexpr double kRemembered = 10;          // frames of a mean: errors of fits differ from frame to frame
constexpr float kImpossible = -1e9f;        // a log-likelihood
constexpr int kMaxEdges = 12;               // between ink and paper, of any of the words
constexpr double kInterpolation = 1 / 6.0;  // variance that bilinear interpolation adds to blur, px^2

/// Directions counter-clockwise as seen in front of the print: those of the sectors' starts, and turns by
/// half samples of the finest ring.
struct Directions {
    float x[kPadded], y[kPadded];
    float cos[2 * kFinest], sin[2 * kFinest];
    Directions() {
        for (int k = 0; k < kPadded; ++k) {
            x[k] = float(std::cos(kTau * k / kCodeSectors));
            y[k] = float(-std::sin(kTau * k / kCodeSectors));
        }
        for (int k = 0; k < 2 * kFinest; ++k) {
            cos[k] = float(std::cos(kTau * k / (2 * kFinest * kCodeSectors)));
            sin[k] = float(std::sin(kTau * k / (2 * kFinest * kCodeSectors)));
        }
    }
    std::pair<float, float> at(int k, int turn) const {
        return {cos[turn] * x[k] + sin[turn] * y[k], cos[turn] * y[k] - sin[turn] * x[k]};
    }
    /// Those of the sectors from `k` on after a turn.
    ROUNDEL_INLINE void at(int k, int turn, Lanes& to_x, Lanes& to_y) const {
        to_x = cos[turn] * load(x + k) + sin[turn] * load(y + k);
        to_y = cos[turn] * load(y + k) - sin[turn] * load(x + k);
    }
};
const Directions kAround;

/// A number for each sector, NaN in the lanes beyond the last one.
struct alignas(4 * kLanes) Sectorwise {
    float at[kPadded];
};

/// The ring of a code as a profile of blackness: 0 for paper, 1 for ink, at samples of its middle.
struct Profile {
    int per_sector;  // samples
    /// Row j has the j-th sample of each sector, row j + per_sector that of the sector after it; NaN outside
    /// of the image.
    Sectorwise rows[2 * kFinest];
    Sectorwise gains;  // blackness per contrast
    /// The sum from the middle of a sector to that of the next one; sectors begin at a sample.
    double between(int sector, int start) const {
        const int first = start + per_sector / 2, column = (sector + first / per_sector) % kCodeSectors;
        const Sectorwise* row = rows + first % per_sector;
        float sum = 0;
        for (int j = 0; j < per_sector; ++j) sum += row[j].at[column];
        return double(sum);
    }
};

/// The bilinearly interpolated grey levels; NaN outside of the image.
ROUNDEL_INLINE Lanes levels_at(const ImageView& image, const Lanes& x, const Lanes& y) {
    const Bits inside =
        (x >= 0.0f) & (y >= 0.0f) & (x < float(image.width - 1)) & (y < float(image.height - 1));
    const Lanes safe_x = inside ? x : all(0), safe_y = inside ? y : all(0);
    const Bits u = __builtin_convertvector(safe_x, Bits), v = __builtin_convertvector(safe_y, Bits);
    Words pixels{};  // a byte each: two of a row, two of the next one
    for (int k = 0; k < kLanes; ++k) {
        const uint8_t* at = image.row(v[k]) + u[k];
        uint16_t upper, lower;
        std::memcpy(&upper, at, sizeof upper);
        std::memcpy(&lower, at + image.stride, sizeof lower);
        pixels[k] = uint32_t(upper) | uint32_t(lower) << 16;
    }
    Lanes levels[4];
    for (int k = 0; k < 4; ++k) levels[k] = __builtin_convertvector(Bits(pixels >> (8 * k) & 255), Lanes);
    const Lanes a = safe_x - __builtin_convertvector(u, Lanes),
                b = safe_y - __builtin_convertvector(v, Lanes);
    const Lanes above = levels[0] + a * (levels[1] - levels[0]);
    const Lanes below = levels[2] + a * (levels[3] - levels[2]);
    return inside ? above + b * (below - above) : all(NAN);
}

/// Samples about a pixel apart. Blur mixes ink with the paper on both sides of the ring, by an amount that
/// follows from the width of the ring's picture there.
ROUNDEL_CLONES void sample_ring(const ImageView& image, const Parameters& p, Profile& to) {
    const double det = std::abs(p[kAxx] * p[kAyy] - p[kAxy] * p[kAxy]);
    const double pixels = kTau * kMiddle * std::sqrt(det) / kCodeSectors;
    const int m = to.per_sector = pixels < 6 ? 4 : pixels < 12 ? 8 : kFinest;
    const auto x0 = float(p[kX]), y0 = float(p[kY]), gx = float(p[kGx]), gy = float(p[kGy]);
    const auto xx = float(p[kAxx]), xy = float(p[kAxy]), yy = float(p[kAyy]);
    const auto bright = float(p[kBright]), per_contrast = float(1 / (p[kBright] - p[kDark]));
    const auto half_width = float((kCodeOuter - kCodeInner) / 2 * det /
                                  std::sqrt(p[kBlur] * p[kBlur] + kInterpolation));  // over the blur
    constexpr auto kRadius = float(kMiddle);
    for (int k = 0; k < kPadded; k += kLanes) {
        Lanes x, y;
        kAround.at(k, kFinest, x, y);
        const Lanes nx = yy * x - xy * y, ny = xx * y - xy * x;
        const Lanes gain =
            1.0f / (1.0f - 2.0f * normal_tail(half_width * inverse_sqrt(nx * nx + ny * ny)).tail);
        store(to.gains.at + k, gain);
        for (int j = 0; j < m; ++j) {
            kAround.at(k, (2 * j + 1) * (kFinest / m), x, y);
            const Lanes scale = kRadius / (1.0f + kRadius * (gx * x + gy * y));
            const Lanes level =
                levels_at(image, x0 + scale * (xx * x + xy * y), y0 + scale * (xy * x + yy * y));
            store(to.rows[j].at + k, (bright - level) * (per_contrast * gain));
        }
    }
    for (int j = 0; j < m; ++j) {
        float *row = to.rows[j].at, *next = to.rows[j + m].at;
        std::fill(row + kCodeSectors, row + kPadded, NAN);
        std::copy(row + 1, row + kPadded, next);
        next[kCodeSectors - 1] = row[0];
        next[kPadded - 1] = NAN;
    }
}

/// The sums of the middle halves of the sectors that begin at a sample.
struct SectorLevels {
    int start;
    Sectorwise black;
};

/// Sectors at the start that separates ink from paper best.
ROUNDEL_CLONES void find_sectors(const Profile& profile, SectorLevels& best) {
    const int m = profile.per_sector;
    float most = -1;
    for (int start = 0; start < m; ++start) {
        SectorLevels now{start, {}};
        Lanes apart{};
        for (int k = 0; k < kPadded; k += kLanes) {
            Lanes black{};
            for (int j = start + m / 4; j < start + m - m / 4; ++j) black += load(profile.rows[j].at + k);
            store(now.black.at + k, black);
            const Lanes off = clamped(black, all(0), all(float(m) / 2)) - float(m) / 4;
            apart += black == black ? off * off : all(0);
        }
        if (const float squares = sum(apart); squares > most) {
            most = squares;
            best = now;
        }
    }
}

/// Log-likelihoods of a frame's sectors over that of no code.
struct SectorScores {
    float most;                           // of any word
    float white;                          // of a white ring
    float black[kCodeSectors + kPadded];  // what each sector adds if it is black, twice around
};

/// A tone curve of curvature kappa, which brightens the levels s between ink and paper by kappa s (1 - s),
/// shows ink of which blur leaves the share 1 / gain paler by kappa (1 - 1 / gain). Least squares for kappa,
/// with its prior, over the sectors that are rather black; `sigma` is that of a level, contrasts.
ROUNDEL_INLINE float find_curvature(const Profile& profile, const SectorLevels& sectors, float per_sigma) {
    Lanes paleness{}, information{};
    for (int k = 0; k < kPadded; k += kLanes) {
        const Lanes per_gain = 1.0f / load(profile.gains.at + k), weight = per_sigma * per_gain;
        const Lanes level = load(sectors.black.at + k) / (float(profile.per_sector) / 2);
        const Lanes by_curvature = level > 0.5f ? weight * (1.0f - per_gain) : all(0);
        paleness += level > 0.5f ? by_curvature * weight * (1.0f - level) : all(0);
        information += by_curvature * by_curvature;
    }
    return sum(paleness) / (sum(information) + 1 / float(square(kCurvaturePrior)));
}

/// `sigma` is that of a level, contrasts. Without a code, all levels within half a contrast of ink and paper
/// are alike.
ROUNDEL_CLONES void score(const Profile& profile, const SectorLevels& sectors, double sigma,
                          SectorScores& to) {
    const auto due = float(std::log((1 - kCovered) * 2 / (std::sqrt(kTau) * sigma)));
    const auto covered = float(std::log(kCovered)), per_sigma = float(1 / sigma);
    const float curvature = find_curvature(profile, sectors, per_sigma);
    const auto improbable = float(square(double(curvature) / kCurvaturePrior) / 2);
    Lanes white_ring{}, most{};
    for (int k = 0; k < kPadded; k += kLanes) {
        const Lanes left = 1.0f / load(profile.gains.at + k), per_gain = per_sigma * left;
        const Lanes level = load(sectors.black.at + k) / (float(profile.per_sector) / 2);
        const auto log_likelihood = [&](const Lanes& expected) __attribute__((always_inline)) {
            const Lanes off = (level - expected) * per_gain, agreeing = due - 0.5f * off * off;
            return level == level ? log_sum(agreeing, all(covered)) : all(0);
        };
        const Lanes white = log_likelihood(all(0)), black = log_likelihood(1.0f - curvature * (1.0f - left));
        store(to.black + k, black - white);
        white_ring += white;
        most += greater(white, black);
    }
    to.most = sum(most) - improbable;
    to.white = sum(white_ring) - improbable;
    for (int k = kCodeSectors; k < kCodeSectors + kPadded; ++k) to.black[k] = to.black[k - kCodeSectors];
}

/// Adds up the scores of parts of words at all turns, one a lane; lanes beyond the last turn repeat the first
/// ones.
class TurnSums {
  public:
    ROUNDEL_INLINE explicit TurnSums(const SectorScores& sectors) {
        for (int part = 0; part < kParts; ++part) {
            auto& table = table_[part];
            for (int v = 0; v < kVectors; ++v) table[0][v] = all(part ? 0 : sectors.white);
            for (int k = 0, n = 1; k < kBits; ++k, n *= 2)
                for (int v = 0; v < kVectors; ++v) {
                    const Lanes black = load(sectors.black + part * kBits + k + v * kLanes);
                    for (int bits = 0; bits < n; ++bits) table[n + bits][v] = table[bits][v] + black;
                }
        }
    }
    ROUNDEL_INLINE Lanes of(Word word, int v) const {
        Lanes sum = table_[0][word & kMask][v];
        for (int part = 1; part < kParts; ++part) sum += table_[part][word >> (part * kBits) & kMask][v];
        return sum;
    }
    static constexpr int kVectors = kPadded / kLanes;

  private:
    static constexpr int kBits = 6, kParts = kCodeSectors / kBits;
    static constexpr Word kMask = (1 << kBits) - 1;
    Lanes table_[kParts][kMask + 1][kVectors];
};

ROUNDEL_CLONES size_t most_probable(const std::vector<float>& codes) {
    Lanes best = load(codes.data());
    for (size_t k = kLanes; k < codes.size(); k += kLanes) best = greater(best, load(&codes[k]));
    return size_t(std::find(codes.begin(), codes.end(), greatest(best)) - codes.begin());
}

/// The log-likelihoods of all codes at their best turns, in whole lanes.
ROUNDEL_CLONES std::vector<float> score_codes(const SectorScores& sectors) {
    const std::vector<Word>& words = code_words();
    const TurnSums sums(sectors);
    std::vector<float> codes((words.size() + kLanes - 1) / kLanes * kLanes, kImpossible);
    for (size_t code = 0; code < words.size(); ++code) {
        Lanes best = sums.of(words[code], 0);
        for (int v = 1; v < TurnSums::kVectors; ++v) best = greater(best, sums.of(words[code], v));
        codes[code] = greatest(best);
    }
    return codes;
}

/// The sum of the likelihoods of all codes but one over that of this one, the most probable, to a power.
ROUNDEL_CLONES double odds_of_others(std::vector<float> codes, size_t one, float power) {
    const float most = std::exchange(codes[one], kImpossible);
    Lanes total{};
    for (size_t k = 0; k < codes.size(); k += kLanes) total += exponential(power * (load(&codes[k]) - most));
    return double(sum(total));
}

/// No code is as probable as any code at any turn.
float log_prior() {
    static const float prior = std::log(float(code_words().size() * kCodeSectors));
    return prior;
}

int best_turn(const SectorScores& sectors, Word word) {
    float sums[kCodeSectors] = {};
    for (; word; word &= word - 1)
        for (int turn = 0; turn < kCodeSectors; ++turn)
            sums[turn] += sectors.black[std::countr_zero(word) + turn];
    return int(std::max_element(sums, sums + kCodeSectors) - sums);
}

/// The angle from the first sample's side to the zero of a word as the fit shows it, and its variance,
/// radians.
struct Zero {
    double angle, variance;
};

/// How errors of the fit displace a direction in its frame: derivatives of the angle by Axx, Axy, Ayy and the
/// offset of the disc's centre, as in `PoseCovariance`.
constexpr int kFitErrors = 5;
Vector<kFitErrors> angle_by_fit(const Parameters& p, double x, double y, double radius) {
    const double det = p[kAxx] * p[kAyy] - p[kAxy] * p[kAxy];
    const double u = (p[kAyy] * y + p[kAxy] * x) / det, v = -(p[kAxy] * y + p[kAxx] * x) / det;
    return {u * x, u * y + v * x, v * y, u / radius, v / radius};
}

/// How much of a neighbouring edge the sum between two middles contains, in sectors: the tail of a blurred
/// edge beyond half a sector.
double leak(double blur) {
    const double z = 0.5 / blur;
    return blur * (std::exp(-z * z / 2) / std::sqrt(kTau) - z / 2 * std::erfc(z / std::numbers::sqrt2));
}

/// The edges between ink and paper: how late each one is, and the covariance of that. Rows beyond the last
/// edge are independent of all others.
struct LateEdges {
    int count = 0;
    Vector<kMaxEdges> late{}, ones{};
    Vector<kMaxEdges> with_zero{};  // covariances with the fit's error at the zero
    std::array<Vector<kMaxEdges>, kMaxEdges> V{};
};

/// Each edge has the noise of its pixels. An error of the levels, which displaces both kinds of edges in
/// opposite directions, and the errors of the fit displace all of them.
LateEdges measure_edges(const Profile& profile, int start, Word seen, double noise, const RoundelFit& fit,
                        const Vector<kFitErrors>& of_zero) {
    const int m = profile.per_sector;
    const double step = kTau / (m * kCodeSectors), level = kModelError * m * step;
    const double spread = std::sqrt(square(fit.p[kBlur]) + kInterpolation);
    const auto black_at = [&](int k) { return int(seen >> (k % kCodeSectors) & 1); };
    LateEdges edges;
    std::array<Vector<kFitErrors>, kMaxEdges> J;
    Vector<kMaxEdges> sign;
    for (int k = 0; k < kCodeSectors && edges.count < kMaxEdges; ++k) {
        const int before = black_at(k), after = black_at(k + 1);
        if (before == after) continue;
        const double black = profile.between(k, start);
        if (!std::isfinite(black)) continue;
        const auto [x, y] = kAround.at(k + 1, 2 * start * kFinest / m);
        const Parameters& p = fit.p;
        const double along_x = p[kAxx] * double(y) - p[kAxy] * double(x);
        const double along_y = p[kAxy] * double(y) - p[kAyy] * double(x);
        const double pixels = kMiddle * kTau / kCodeSectors * std::sqrt(square(along_x) + square(along_y));
        const int next = after != black_at(k + 2), last = before != black_at(k + kCodeSectors - 1);
        const auto row = size_t(edges.count++);
        sign[row] = before ? 1 : -1;
        edges.ones[row] = 1;
        edges.late[row] = step * sign[row] * (black - m / 2.0);
        if (next != last) edges.late[row] -= step * m * leak(spread / pixels) * (next - last);
        // Along a line, pixels interpolated bilinearly have 2/3 of the variance of one pixel a pixel; samples
        // that are farther apart have 4/9 each.
        const double samples = m * 2 / 3.0 * std::max(m / pixels, 2 / 3.0);
        edges.V[row][row] = samples * square(step * noise * double(profile.gains.at[k])) * fit.correlation;
        J[row] = angle_by_fit(p, double(x), double(y), kMiddle);
    }
    for (size_t i = 0; i < kMaxEdges; ++i) {
        if (i >= size_t(edges.count)) {
            edges.V[i][i] = 1;
            continue;
        }
        Vector<kFitErrors> with_fit{};
        for (size_t a = 0; a < kFitErrors; ++a)
            for (size_t b = 0; b < kFitErrors; ++b) with_fit[a] += fit.pose_cov[2 + a][2 + b] * J[i][b];
        for (size_t j = 0; j <= i; ++j) {
            const Vector<kFitErrors>& b = J[j];
            edges.V[i][j] += sign[i] * sign[j] * square(level) + (with_fit[0] * b[0] + with_fit[1] * b[1]) +
                             (with_fit[2] * b[2] + with_fit[3] * b[3]) + with_fit[4] * b[4];
        }
        for (size_t a = 0; a < kFitErrors; ++a) edges.with_zero[i] += with_fit[a] * of_zero[a];
    }
    return edges;
}

double product(const Vector<kMaxEdges>& a, const Vector<kMaxEdges>& b) {
    double sum = 0;
    for (size_t k = 0; k < kMaxEdges; ++k) sum += a[k] * b[k];
    return sum;
}

/// Generalized least squares (Aitken 1935) for the turn, and the error of the fit at the zero as the edges
/// predict it (Goldberger 1962). Where residuals exceed the claims, the variance grows with them; by
/// chi-square / (n - 3) in place of (n - 1), so that the mean squared error over the claim is 1.
Zero find_zero(const Profile& profile, int start, Word seen, int turn, double noise, const RoundelFit& fit) {
    const double at = kTau / kCodeSectors * (turn + double(start) / profile.per_sector);
    Vector<kFitErrors> of_zero = angle_by_fit(fit.p, std::cos(at), -std::sin(at), 1);
    of_zero[0] = of_zero[1] = of_zero[2] = 0;  // the published angle is that on the outline
    const LateEdges edges = measure_edges(profile, start, seen, noise, fit, of_zero);
    const Cholesky<kMaxEdges> factor(edges.V);
    if (edges.count <= 3 || !factor.positive()) return {NAN, NAN};
    const Vector<kMaxEdges> ones = factor.halfway(edges.ones), with_zero = factor.halfway(edges.with_zero);
    Vector<kMaxEdges> residual = factor.halfway(edges.late);
    const double information = product(ones, ones), late = product(ones, residual) / information;
    for (size_t k = 0; k < kMaxEdges; ++k) residual[k] -= late * ones[k];
    const double excess = std::max(1.0, product(residual, residual) / (edges.count - 3));
    double variance = square(1 - product(ones, with_zero)) / information - product(with_zero, with_zero);
    for (size_t a = 3; a < kFitErrors; ++a)
        for (size_t b = 3; b < kFitErrors; ++b)
            variance += of_zero[a] * fit.pose_cov[2 + a][2 + b] * of_zero[b];
    return {at + late + product(with_zero, residual), excess * variance};
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
    const double noise = std::max(1.0, fit.noise) / (fit.p[kBright] - fit.p[kDark]);
    const double sigma = std::hypot(noise, kModelError);
    Profile profile;
    SectorLevels sectors;
    SectorScores scores;
    sample_ring(image, fit.p, profile);
    find_sectors(profile, sectors);
    score(profile, sectors, sigma, scores);
    // Without a code, most rings are less probable with any word than without.
    if (means_.empty() && scores.most < log_prior()) return {};
    const std::vector<float> codes = score_codes(scores);
    include(codes);
    if (means_.empty()) return {};

    const double rho = square(kModelError / sigma), frames = count_ / (1 + (count_ - 1) * rho);
    const size_t best = most_probable(means_);
    const double others = odds_of_others(means_, best, float(frames)) +
                          std::exp(double(log_prior()) - frames * double(means_[best]));
    if (!(others < kMaxError)) return {};
    const int name = int(best) + 1;
    if (codes[best] < 0) return {name, 1 / (1 + others), NAN, NAN};  // covered
    const Word word = code_words()[best];
    const int turn = best_turn(scores, word);
    const Zero zero = find_zero(profile, sectors.start, turned(word, turn), turn, noise, fit);
    return {name, 1 / (1 + others), on_ellipse(fit.p, zero.angle), std::sqrt(zero.variance)};
}

/// Adds a frame's log-likelihoods to the means of the track. They start anew where the track has more
/// probably become another roundel's, and end where no code is more probable than all.
void CodeTrack::include(const std::vector<float>& codes) {
    const float most = std::max(log_prior(), codes[most_probable(codes)]);
    if (means_.empty() || double(most - codes[most_probable(means_)]) > -std::log(kChanged)) {
        means_.assign(codes.size(), 0);
        count_ = 0;
    }
    count_ = std::min(count_ + 1, kRemembered);
    for (size_t k = 0; k < codes.size(); ++k) means_[k] += (codes[k] - means_[k]) / float(count_);
    if (means_[most_probable(means_)] < log_prior()) means_.clear();
}

}  // namespace roundel
