// SPDX-License-Identifier: BSD-3-Clause
#include "code/code_reader.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <numbers>
#include <numeric>
#include <optional>

#include "numeric/cholesky.hpp"
#include "numeric/gram.hpp"
#include "numeric/lanes.hpp"
#include "numeric/simd.hpp"

namespace roundel {

namespace {

constexpr double kTau = 2 * std::numbers::pi;
constexpr int kFinest = 16;                                    // samples of a sector, at most
constexpr int kSampleStep = 4;                                 // of which their number is a multiple
constexpr int kPadded = (kCodeSectors / kLanes + 1) * kLanes;  // sectors in whole lanes
constexpr double kMiddle = (kCodeInner + kCodeOuter) / 2;
constexpr double kMaxError = 1e-6;  // probability of a wrong name that counts as certain
const double kLogMaxError = std::log(kMaxError);
constexpr double kCovered = 0.02;  // prior probability that something covers a sector
constexpr double kChanged = 1e-3;  // and that a track has become another roundel's
const double kLogChanged = std::log(kChanged);
constexpr double kModelError = 0.1;         // of a sector's level, contrasts
constexpr double kRemembered = 10;          // frames of a mean: errors of fits differ from frame to frame
constexpr float kImpossible = -1e9f;        // a log-likelihood
constexpr double kInterpolation = 1 / 6.0;  // variance that bilinear interpolation adds to blur, px^2

constexpr int kMostSamples = kFinest * kCodeSectors;
constexpr int kTurns = 48;  // in a sector, so that samples of 4, 8, 12 and 16 a sector begin at turns
constexpr Bits kLane{0, 1, 2, 3, 4, 5, 6, 7};

constexpr size_t whole_lanes(size_t count) { return (count + kLanes - 1) / kLanes * kLanes; }

/// Directions counter-clockwise as seen in front of the print: those of the sectors' starts, and turns by
/// parts of a sector.
struct Directions {
    float x[kPadded + 1], y[kPadded + 1];
    float cos[kTurns], sin[kTurns];
    Directions() {
        for (int k = 0; k <= kPadded; ++k) {
            x[k] = float(std::cos(kTau * k / kCodeSectors));
            y[k] = float(-std::sin(kTau * k / kCodeSectors));
        }
        for (int k = 0; k < kTurns; ++k) {
            cos[k] = float(std::cos(kTau * k / (kTurns * kCodeSectors)));
            sin[k] = float(std::sin(kTau * k / (kTurns * kCodeSectors)));
        }
    }
    /// Those of the sectors from `k` on after a turn.
    ROUNDEL_INLINE void at(int k, int turn, Lanes& to_x, Lanes& to_y) const {
        to_x = cos[turn] * load(x + k) + sin[turn] * load(y + k);
        to_y = cos[turn] * load(y + k) - sin[turn] * load(x + k);
    }
};
const Directions kAround;

/// Directions of a ring's samples: the first samples of all sectors, then the second ones, and so on.
struct SampleDirections {
    alignas(4 * kLanes) float x[kMostSamples], y[kMostSamples];
    explicit SampleDirections(int per_sector) {
        for (int k = 0; k < per_sector * kCodeSectors; ++k) {
            const double sector = k % kCodeSectors + (k / kCodeSectors + 0.5) / per_sector;
            x[k] = float(std::cos(kTau * sector / kCodeSectors));
            y[k] = float(-std::sin(kTau * sector / kCodeSectors));
        }
    }
};
const SampleDirections kSamples[] = {SampleDirections(4), SampleDirections(8), SampleDirections(12),
                                     SampleDirections(kFinest)};

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
    /// From the first samples of all sectors, the second ones, and so on, with room for lanes behind.
    ROUNDEL_INLINE void arrange(const float* samples) {
        for (int j = 0; j < per_sector; ++j, samples += kCodeSectors)
            for (int k = 0; k < kPadded; k += kLanes) {
                const Bits is_sector = kLane + k < kCodeSectors, has_next = kLane + k < kCodeSectors - 1;
                store(rows[j].at + k, is_sector ? load(samples + k) : all(NAN));
                store(rows[j + per_sector].at + k, has_next ? load(samples + k + 1) : all(NAN));
            }
        for (int j = 0; j < per_sector; ++j) rows[j + per_sector].at[kCodeSectors - 1] = rows[j].at[0];
    }
};

/// The pixels between which samples of a ring are, and their interpolated levels. Places, pixels and levels
/// are computed one after the other, so that the processor does not wait for each sample's pixels.
class RingSamples {
  public:
    /// Puts the samples from `k` on at places in the image.
    ROUNDEL_INLINE void put(int k, const Lanes& x, const Lanes& y, const ImageView& image) {
        const Bits inside =
            (x >= 0.0f) & (y >= 0.0f) & (x < float(image.width - 1)) & (y < float(image.height - 1));
        const Lanes safe_x = inside ? x : all(0), safe_y = inside ? y : all(0);
        const Bits u = __builtin_convertvector(safe_x, Bits), v = __builtin_convertvector(safe_y, Bits);
        const Bits offset = v * int(image.stride) + u;
        __builtin_memcpy(offset_ + k, &offset, sizeof offset);
        store(right_ + k, inside ? safe_x - __builtin_convertvector(u, Lanes) : all(NAN));
        store(down_ + k, safe_y - __builtin_convertvector(v, Lanes));
    }
    ROUNDEL_INLINE void read_pixels(const ImageView& image, int count) {
        const uint8_t* const upper = image.data;
        const uint8_t* const lower = image.data + image.stride;
        for (int k = 0; k < count; ++k) {
            std::memcpy(&upper_[k], upper + offset_[k], sizeof *upper_);
            std::memcpy(&lower_[k], lower + offset_[k], sizeof *lower_);
        }
    }
    /// The levels of the samples from `k` on; NaN outside of the image.
    ROUNDEL_INLINE Lanes levels(int k) const {
        const Lanes right = load(right_ + k);
        const Lanes above = between(upper_ + k, right), below = between(lower_ + k, right);
        return above + load(down_ + k) * (below - above);
    }

  private:
    ROUNDEL_INLINE static Lanes between(const uint16_t* pairs, const Lanes& right) {
        typedef uint16_t Pairs __attribute__((vector_size(2 * kLanes)));
        Pairs pair;
        __builtin_memcpy(&pair, pairs, sizeof pair);
        const Bits bytes = __builtin_convertvector(pair, Bits);
        const Lanes one = __builtin_convertvector(bytes & 255, Lanes);
        return one + right * (__builtin_convertvector(bytes >> 8, Lanes) - one);
    }
    float right_[kMostSamples], down_[kMostSamples];      // of the pixel above on the left, pixels
    int offset_[kMostSamples];                            // of that one in the image
    uint16_t upper_[kMostSamples], lower_[kMostSamples];  // that pixel and the next one, and those below
};

/// The number of samples of a sector of some pixels. An edge's variance (`add_edges`) is the same for all
/// samples that are up to 1.5 pixels apart, since neighbouring ones are interpolated from the same pixels.
int samples_of(double pixels) {
    constexpr double kApart = 1.5;
    return std::clamp(kSampleStep * int(std::ceil(pixels / (kApart * kSampleStep))), kSampleStep, kFinest);
}

/// Levels of samples of the ring, and how much blur reduces the contrast of the sectors. Blur mixes ink with
/// the paper on both sides of the ring, by an amount that follows from the width of the ring's picture there.
ROUNDEL_CLONES void sample_ring(const ImageView& image, const Parameters& p, Profile& to) {
    const double det = std::abs(p[kAxx] * p[kAyy] - p[kAxy] * p[kAxy]);
    const int m = to.per_sector = samples_of(kTau * kMiddle * std::sqrt(det) / kCodeSectors);
    const auto x0 = float(p[kX]), y0 = float(p[kY]), gx = float(p[kGx]), gy = float(p[kGy]);
    const auto xx = float(p[kAxx]), xy = float(p[kAxy]), yy = float(p[kAyy]);
    const auto bright = float(p[kBright]), per_contrast = float(1 / (p[kBright] - p[kDark]));
    const auto half_width = float((kCodeOuter - kCodeInner) / 2 * det /
                                  std::sqrt(p[kBlur] * p[kBlur] + kInterpolation));  // over the blur
    constexpr auto kRadius = float(kMiddle);
    float gains[kCodeSectors + kPadded];  // twice around
    for (int k = 0; k < kPadded; k += kLanes) {
        Lanes x, y;
        kAround.at(k, kTurns / 2, x, y);
        const Lanes nx = yy * x - xy * y, ny = xx * y - xy * x;
        const Lanes gain =
            1.0f / (1.0f - 2.0f * normal_tail(half_width * inverse_sqrt(nx * nx + ny * ny)).tail);
        store(to.gains.at + k, gain);
        store(gains + k, gain * per_contrast);
    }
    for (int k = 0; k < kPadded; k += kLanes) store(gains + kCodeSectors + k, load(gains + k));
    const SampleDirections& directions = kSamples[m / kSampleStep - 1];
    RingSamples samples;
    for (int k = 0; k < m * kCodeSectors; k += kLanes) {
        const Lanes x = load(directions.x + k), y = load(directions.y + k);
        const Lanes scale = kRadius / (1.0f + kRadius * (gx * x + gy * y));
        samples.put(k, x0 + scale * (xx * x + xy * y), y0 + scale * (xy * x + yy * y), image);
    }
    samples.read_pixels(image, m * kCodeSectors);
    float black[kMostSamples + kPadded];
    for (int k = 0; k < m * kCodeSectors; k += kLanes)
        store(black + k, (bright - samples.levels(k)) * load(gains + k % kCodeSectors));
    to.arrange(black);
}

/// The sums of the middle halves of the sectors that begin at a sample.
struct SectorLevels {
    int start;
    Sectorwise black;
};

/// The sums of the middle halves of the sectors from `k` on that begin at a sample.
ROUNDEL_INLINE Lanes middle_of(const Profile& profile, int start, int k) {
    const int m = profile.per_sector;
    Lanes black{};
    for (int j = start + m / 4; j < start + m - m / 4; ++j) black += load(profile.rows[j].at + k);
    return black;
}

/// Sectors at the start that separates ink from paper best, of eight or less.
ROUNDEL_CLONES void find_sectors(const Profile& profile, SectorLevels& best) {
    const float most = float(profile.per_sector) / 2;
    float greatest_squares = -1;
    const int step = (profile.per_sector + 7) / 8;
    for (int start = 0; start < profile.per_sector; start += step) {
        Lanes apart{};
        for (int k = 0; k < kPadded; k += kLanes) {
            const Lanes black = middle_of(profile, start, k);
            const Lanes off = clamped(black, all(0), all(most)) - most / 2;
            apart += black == black ? off * off : all(0);
        }
        const float squares = sum(apart);
        best.start = squares > greatest_squares ? start : best.start;
        greatest_squares = std::max(squares, greatest_squares);
    }
    for (int k = 0; k < kPadded; k += kLanes) store(best.black.at + k, middle_of(profile, best.start, k));
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

/// The code of a ring's word. Each code's word is the least of all its turns, and words are in order.
std::optional<size_t> find_code(Word ring) {
    Word least = ring;
    for (int turn = 1; turn < kCodeSectors; ++turn) least = std::min(least, turned(ring, turn));
    const std::vector<Word>& words = code_words();
    const auto found = std::lower_bound(words.begin(), words.end(), least);
    if (found == words.end() || *found != least) return std::nullopt;
    return size_t(found - words.begin());
}

/// The more probable colour of each sector.
Word most_probable_word(const SectorScores& sectors) {
    Word word = 0;
    for (int k = 0; k < kCodeSectors; ++k) word |= Word(sectors.black[k] > 0) << k;
    return word;
}

/// How much less probable, at least, all other words of the book are than the most probable one, if that is
/// in the book: they differ from it in `kCodeDistance` sectors, which are the least certain ones at best.
float least_difference(const SectorScores& sectors) {
    float least[kCodeDistance];
    std::fill_n(least, kCodeDistance, -kImpossible);
    for (int k = 0; k < kCodeSectors; ++k) {
        float decided = std::abs(sectors.black[k]);
        for (float& one : least) {
            const float more = std::max(one, decided);
            one = std::min(one, decided);
            decided = more;
        }
    }
    return std::accumulate(least, least + kCodeDistance, 0.0f);
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

ROUNDEL_CLONES float greatest_of(const std::vector<float>& codes) {
    Lanes best = load(codes.data());
    for (size_t k = kLanes; k < codes.size(); k += kLanes) best = greater(best, load(&codes[k]));
    return greatest(best);
}

/// The log-likelihoods of all codes at their best turns, in whole lanes.
ROUNDEL_CLONES void score_codes(const SectorScores& sectors, std::vector<float>& codes) {
    const std::vector<Word>& words = code_words();
    const TurnSums sums(sectors);
    codes.assign(whole_lanes(words.size()), kImpossible);
    for (size_t code = 0; code < words.size(); ++code) {
        Lanes best = sums.of(words[code], 0);
        for (int v = 1; v < TurnSums::kVectors; ++v) best = greater(best, sums.of(words[code], v));
        codes[code] = greatest(best);
    }
}

/// The same with upper bounds for all codes but one, if the more probable colours of the sectors are that
/// one's word, and the bounds are sufficient for a name. This is so for most reads, and takes a sixth of the
/// time.
bool bound_codes(const SectorScores& sectors, std::vector<float>& codes) {
    const std::optional<size_t> nearest = find_code(most_probable_word(sectors));
    if (!nearest) return false;
    const size_t count = code_words().size();
    const float less = least_difference(sectors);
    if (double(less) < std::log(double(count)) - kLogMaxError) return false;
    codes.assign(whole_lanes(count), kImpossible);
    std::fill_n(codes.begin(), count, sectors.most - less);
    codes[*nearest] = sectors.most;
    return true;
}

/// The sum of the likelihoods of all codes but one over that of this one, the most probable, to a power.
ROUNDEL_CLONES double odds_of_others(const std::vector<float>& codes, size_t one, float power) {
    const float most = codes[one];
    const size_t own = one / kLanes * kLanes;
    Lanes others = load(&codes[own]), total{};
    others[one - own] = kImpossible;
    for (size_t k = 0; k < codes.size(); k += kLanes)
        total += exponential(power * ((k == own ? others : load(&codes[k])) - most));
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

/// How errors of the fit displace a direction in its frame: those of Axx, Axy, Ayy and of the offset of the
/// disc's centre, as in `PoseCovariance`, are L times independent errors of variance 1.
constexpr int kFitErrors = 5;
class AngleByFit {
  public:
    AngleByFit(const Parameters& p, const Cholesky<kFitErrors>& errors) {
        const double det = p[kAxx] * p[kAyy] - p[kAxy] * p[kAxy];
        xx_ = float(p[kAyy] / det);
        xy_ = float(-p[kAxy] / det);
        yy_ = float(p[kAxx] / det);
        for (size_t a = 0; a < kFitErrors; ++a)
            for (size_t b = 0; b <= a; ++b) L_[a][b] = float(errors.at(a, b));
    }
    /// Derivatives of the angle on the circle in the middle of the code's ring.
    ROUNDEL_INLINE void in_ring(const Lanes& x, const Lanes& y, Lanes* to) const {
        const Lanes u = xx_ * y - xy_ * x, v = xy_ * y - yy_ * x;
        constexpr auto kPerRadius = float(1 / kMiddle);
        by_errors({u * x, u * y + v * x, v * y, kPerRadius * u, kPerRadius * v}, to);
    }
    /// Those of the angle on the outline, which errors of its shape do not turn.
    void on_outline(float x, float y, float* to) const {
        by_errors<float>({0, 0, 0, xx_ * y - xy_ * x, xy_ * y - yy_ * x}, to);
    }

  private:
    template <typename Number>
    ROUNDEL_INLINE void by_errors(const Number (&J)[kFitErrors], Number* to) const {
        for (int b = 0; b < kFitErrors; ++b) {
            to[b] = L_[kFitErrors - 1][b] * J[kFitErrors - 1];
            for (int a = b; a < kFitErrors - 1; ++a) to[b] += L_[a][b] * J[a];
        }
    }
    float xx_, xy_, yy_;  // the inverse of A
    float L_[kFitErrors][kFitErrors];
};

/// How much of a neighbouring edge the sum between two middles contains, in sectors: the tail of a blurred
/// edge beyond half a sector.
ROUNDEL_INLINE Lanes leak(const Lanes& blur) {
    constexpr auto kPeak = float(std::numbers::inv_sqrtpi / std::numbers::sqrt2);  // of the normal density
    const Lanes z = 0.5f / blur;
    return blur * (kPeak * exponential(-0.5f * z * z) - z * normal_tail(z).tail);
}

/// Bits of a word from `first` on, as lanes that are set or 0.
ROUNDEL_INLINE Bits bits_of(Word word, int first) {
    constexpr Bits kPlaces{1, 2, 4, 8, 16, 32, 64, 128};
    return (kPlaces & int(word >> first)) != 0;
}

/// Unknowns of the edges between ink and paper: the turn, an error of the levels, which displaces
/// both kinds of edges in opposite directions, and errors of the fit, which displace all of them. All but the
/// turn have the variance 1.
constexpr int kUnknowns = 2 + kFitErrors;

/// Sums over the edges, each divided by the variance that its pixels' noise gives it: the products of the
/// derivatives by the unknowns, and of how late an edge is, in the last row and column; the upper triangle.
struct EdgeSums {
    int count;  // of edges
    double of[kUnknowns + 1][kUnknowns + 1];
};

/// Edge k is that between sectors k and k + 1, in the column in whose rows its samples begin.
ROUNDEL_CLONES void add_edges(const Profile& profile, int start, Word seen, double noise,
                              const RoundelFit& fit, const AngleByFit& by_fit, EdgeSums& to) {
    const int m = profile.per_sector, begin = start + m / 2, carry = begin / m;
    const Sectorwise* const rows = profile.rows + begin % m;
    const Word edges = seen ^ turned(seen, -1);
    const Word at = turned(edges, carry), next = turned(edges, carry - 1), last = turned(edges, carry + 1);
    const Word black_before = turned(seen, carry);
    const Parameters& p = fit.p;
    const auto xx = float(p[kAxx]), xy = float(p[kAxy]), yy = float(p[kAyy]);
    const auto step = float(kTau / (m * kCodeSectors)), width = step * float(m);
    const auto spread = float(std::sqrt(square(p[kBlur]) + kInterpolation));
    const auto pixel = float(2 * m / 3.0 * square(double(step) * noise) * fit.correlation);
    Columns<kUnknowns + 1> columns;
    Lanes count{};
    for (int v = 0, k = 0; k < kPadded; ++v, k += kLanes) {
        Lanes black{};
        for (int j = 0; j < m; ++j) black += load(rows[j].at + k);
        const Bits is_edge = bits_of(at, k) & (black == black);
        count += is_edge ? all(1) : all(0);
        Lanes x, y, by[kFitErrors];
        kAround.at(k + 1 - carry, start * kTurns / m, x, y);
        const Lanes nx = xx * y - xy * x, ny = xy * y - yy * x, squared = nx * nx + ny * ny;
        const Lanes per_sector = inverse_sqrt(squared) / (width * float(kMiddle));  // sectors of a pixel
        const Lanes sign = bits_of(black_before, k) ? all(1) : all(-1);
        const Lanes tails = (bits_of(next, k) ? all(1) : all(0)) - (bits_of(last, k) ? all(1) : all(0));
        const Lanes late = step * sign * (black - float(m) / 2) - width * tails * leak(spread * per_sector);
        // Along a line, pixels interpolated bilinearly have 2/3 of the variance of one pixel a pixel; samples
        // that are farther apart have 4/9 each.
        const Lanes gain = load(profile.gains.at + k);
        const Lanes variance = pixel * gain * gain * greater(float(m) * per_sector, all(2 / 3.0f));
        const Lanes weight = inverse_sqrt(variance);
        by_fit.in_ring(x, y, by);
        const auto put = [&](int column, const Lanes& value) __attribute__((always_inline)) {
            columns[column][v] = is_edge ? weight * value : all(0);
        };
        put(0, all(1));
        put(1, sign * (float(kModelError) * width));
        for (int a = 0; a < kFitErrors; ++a) put(2 + a, by[a]);
        put(kUnknowns, late);
    }
    Gram<kUnknowns + 1> products{};
    multiply_all<kUnknowns + 1>(columns, kPadded / kLanes, products);
    to.count = int(sum(count));
    for (int a = 0; a <= kUnknowns; ++a)
        for (int b = a; b <= kUnknowns; ++b) to.of[a][b] = double(sum(products[a][b]));
}

/// Least squares for the turn, with the priors of the other unknowns.
struct ZeroEquations {
    std::array<Vector<kUnknowns>, kUnknowns> H;
    Vector<kUnknowns> g;
    explicit ZeroEquations(const EdgeSums& sums) {
        for (int a = 0; a < kUnknowns; ++a) {
            g[a] = sums.of[a][kUnknowns];
            for (int b = 0; b <= a; ++b) H[a][b] = H[b][a] = sums.of[b][a];
            H[a][a] += a > 0;
        }
    }
};

double product(const Vector<kUnknowns>& a, const Vector<kUnknowns>& b) {
    double sum = 0;
    for (size_t k = 0; k < kUnknowns; ++k) sum += a[k] * b[k];
    return sum;
}

/// Least squares for the turn and the errors that displace edges, and from these the zero on the outline.
/// Where residuals exceed the claims, the variance grows with them; by chi-square / (n - 3) in place of
/// (n - 1), so that the mean squared error over the claim is 1.
Zero find_zero(const Profile& profile, int start, Word seen, int turn, double noise, const RoundelFit& fit) {
    std::array<Vector<kFitErrors>, kFitErrors> cov;
    for (size_t a = 0; a < kFitErrors; ++a) std::copy_n(&fit.pose_cov[2 + a][2], kFitErrors, cov[a].begin());
    const Cholesky<kFitErrors> errors(cov);
    if (!errors.positive()) return {NAN, NAN};
    const AngleByFit by_fit(fit.p, errors);
    EdgeSums sums;
    add_edges(profile, start, seen, noise, fit, by_fit, sums);
    const ZeroEquations equations(sums);
    const Cholesky<kUnknowns> factor(equations.H);
    if (sums.count <= 3 || !factor.positive()) return {NAN, NAN};

    const double at = kTau / kCodeSectors * (turn + double(start) / profile.per_sector);
    float of_zero[kFitErrors];
    by_fit.on_outline(float(std::cos(at)), float(-std::sin(at)), of_zero);
    Vector<kUnknowns> published{1, 0};
    std::copy_n(of_zero, kFitErrors, published.begin() + 2);
    published = factor.halfway(published);
    const Vector<kUnknowns> found = factor.halfway(equations.g);
    const double misfit = sums.of[kUnknowns][kUnknowns] - product(found, found);
    const double excess = std::max(1.0, misfit / (sums.count - 3));
    return {at + product(published, found), excess * product(published, published)};
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
    const double sigma = std::sqrt(square(noise) + square(kModelError));
    Profile profile;
    SectorLevels sectors;
    SectorScores scores;
    sample_ring(image, fit.p, profile);
    find_sectors(profile, sectors);
    score(profile, sectors, sigma, scores);
    // Without a code, most rings are less probable with any word than without.
    if (means_.empty() && scores.most < log_prior()) return {};
    std::vector<float> codes;
    if (!bound_codes(scores, codes)) score_codes(scores, codes);
    include(codes);
    if (means_.empty()) return {};

    const size_t best = best_;
    const double rho = square(kModelError / sigma), frames = count_ / (1 + (count_ - 1) * rho);
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
    const float most = std::max(log_prior(), greatest_of(codes));
    if (means_.empty() || double(most - codes[best_]) > -kLogChanged) {
        means_.assign(codes.size(), 0);
        count_ = 0;
    }
    count_ = std::min(count_ + 1, kRemembered);
    for (size_t k = 0; k < codes.size(); ++k) means_[k] += (codes[k] - means_[k]) / float(count_);
    const float best = greatest_of(means_);
    best_ = size_t(std::find(means_.begin(), means_.end(), best) - means_.begin());
    if (best < log_prior()) means_.clear();
}

}  // namespace roundel
