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

/// `sigma` is that of a level, contrasts. Without a code, all levels within half a contrast of ink and paper
/// are alike.
ROUNDEL_CLONES void score(const Profile& profile, const SectorLevels& sectors, double sigma,
                          SectorScores& to) {
    const auto due = float(std::log((1 - kCovered) * 2 / (std::sqrt(kTau) * sigma)));
    const auto covered = float(std::log(kCovered)), per_sigma = float(1 / sigma);
    Lanes white_ring{}, most{};
    for (int k = 0; k < kPadded; k += kLanes) {
        const Lanes per_gain = per_sigma / load(profile.gains.at + k);
        const Lanes level = load(sectors.black.at + k) / (float(profile.per_sector) / 2);
        const auto log_likelihood = [&](float expected) __attribute__((always_inline)) {
            const Lanes off = (level - expected) * per_gain, agreeing = due - 0.5f * off * off;
            return level == level ? log_sum(agreeing, all(covered)) : all(0);
        };
        const Lanes white = log_likelihood(0), black = log_likelihood(1);
        store(to.black + k, black - white);
        white_ring += white;
        most += greater(white, black);
    }
    to.most = sum(most);
    to.white = sum(white_ring);
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

/// The angle from the first sample's side to the zero of a word, and its variance, radians.
struct Zero {
    double angle, variance;
};

/// Least squares over the edges between ink and paper. Unknowns: an error of the levels, which displaces both
/// kinds of edges in opposite directions; the displacement of the ring's centre, of which the fit has the
/// variance `centre` in radians of the ring; the lateness of the zero. Lengths are in samples.
Zero find_zero(const Profile& profile, int start, Word seen, int turn, double noise, double centre) {
    constexpr int kUnknowns = 4;
    const int m = profile.per_sector;
    const double step = kTau / (m * kCodeSectors), prior = m * square(noise) * square(step) / centre;
    std::array<Vector<kUnknowns>, kUnknowns> H{};
    Vector<kUnknowns> right{};
    double squares = 0, gain = 0;
    int edges = 0;
    H[1][1] = H[2][2] = prior;
    for (int k = 0; k < kCodeSectors; ++k) {
        const bool before = seen >> k & 1, after = seen >> ((k + 1) % kCodeSectors) & 1;
        if (before == after) continue;
        const double black = profile.between(k, start);
        if (!std::isfinite(black)) continue;
        const double late = before ? black - m / 2.0 : m / 2.0 - black;
        const auto [x, y] = kAround.at(k + 1, 2 * start * kFinest / m);
        const Vector<kUnknowns> J{before ? 1.0 : -1.0, double(x), double(-y), 1};
        for (size_t i = 0; i < kUnknowns; ++i) {
            right[i] += J[i] * late;
            for (size_t j = 0; j <= i; ++j) H[i][j] += J[i] * J[j];
        }
        squares += late * late;
        gain += square(double(profile.gains.at[k]));
        ++edges;
    }
    const Cholesky<kUnknowns> factor(H);
    if (!factor.positive()) return {0, INFINITY};
    const Vector<kUnknowns> x = factor.solve(right);
    for (size_t i = 0; i < kUnknowns; ++i) squares -= right[i] * x[i];
    // Both edges of an arc are wrong together where compression or blur displaces it: they count as one.
    const double variance =
        2 * std::max(m * square(noise) * gain / edges, squares / std::max(1, edges - kUnknowns));
    return {step * (start + turn * m + x[3]), square(step) * variance * factor.inverse_tail<1>()[0][0]};
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
    // The fit measures the offset of the disc's centre; that of the ring's centre is as large relative to it.
    const Symmetric offset = fit.offset_covariance();
    const double centre = (offset.xx + offset.yy) / (2 * fit.outer.major * fit.outer.minor / 4) *
                          square((square(kMiddle) - 1) / kMiddle);
    const Word word = code_words()[best];
    const int turn = best_turn(scores, word);
    const Zero zero = find_zero(profile, sectors.start, turned(word, turn), turn, noise, centre);
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
