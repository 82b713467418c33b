// SPDX-License-Identifier: BSD-3-Clause
#include "fit/occlusion.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>
#include <numeric>

#include "numeric/cholesky.hpp"
#include "numeric/simd.hpp"

namespace roundel {

namespace {

constexpr double kBand = 2;       // half width of the band around an edge, pixels
constexpr int kPixels = 1500;     // approximate number of pixels used
constexpr double kReach = 2;      // blur of an occluding object's edge, pixels
constexpr int kAround = 2;        // sectors on either side that a mean includes
constexpr size_t kCluster = 4;    // sectors whose residuals may be correlated: an eighth of the turn
constexpr double kMinSeen = 0.2;  // of the information in a mean if the whole edge is visible

/// The direction of (x, y) in radians from -pi to pi, within 4e-4: a polynomial in the tangent or its
/// inverse.
ROUNDEL_INLINE Lanes direction(const Lanes& x, const Lanes& y) {
    const Lanes across = magnitude(x), up = magnitude(y), least = across < up ? across : up;
    const Lanes most = (across < up ? up : across) + 1e-9f, t = least / most, tt = t * t;
    Lanes angle = t + t * tt * (-0.327622764f + tt * (0.15931422f - tt * 0.0464964749f));
    angle = up > across ? float(std::numbers::pi / 2) - angle : angle;
    angle = x < 0.0f ? float(std::numbers::pi) - angle : angle;
    return y < 0.0f ? -angle : angle;
}

/// Assigns pixels to the nearest edge of the ring and to a sector of it.
class SectorIndex {
  public:
    explicit SectorIndex(const Parameters& p)
        : x_(float(p[kX])), y_(float(p[kY])), between_(float((1 + p[kRatio]) * (1 + p[kRatio]) / 4)) {
        const double det = p[kAxx] * p[kAyy] - p[kAxy] * p[kAxy];
        xx_ = float(p[kAyy] / det);
        xy_ = float(-p[kAxy] / det);
        yy_ = float(p[kAxx] / det);
    }
    /// The number of a sector of the outer edge, or kSectors plus that of a sector of the inner edge.
    ROUNDEL_INLINE Bits locate(const Lanes& x, const Lanes& y) const {
        const Lanes dx = x - x_, dy = y - y_, qx = xx_ * dx + xy_ * dy, qy = xy_ * dx + yy_ * dy;
        const Lanes turn = direction(qx, qy) * float(kSectors / (2 * std::numbers::pi)) + float(kSectors);
        const Bits inner = qx * qx + qy * qy < between_;  // -1 where it is true
        return (__builtin_convertvector(turn, Bits) & (kSectors - 1)) + (inner & kSectors);
    }

  private:
    float x_, y_, between_, xx_, xy_, yy_;
};

/// Adds residuals to the sums of the outer and of the inner edge.
ROUNDEL_CLONES void add_misfit(const EdgePixels& pixels, const Model& model, const SectorIndex& index,
                               std::array<SectorSums, 2>& edges) {
    Gradient at;
    for (int begin = 0; begin < pixels.count; begin += kChunk * kLanes) {
        const int lanes = std::min(kChunk, (pixels.count - begin) / kLanes);
        const float *x = pixels.x + begin, *y = pixels.y + begin;
        model.evaluate(x, y, pixels.level + begin, lanes, at);
        for (int n = 0; n < lanes; ++n) {
            const Bits place = index.locate(load(x + n * kLanes), load(y + n * kLanes));
            const Lanes slope = at.ring[n], residual = at.residual[n];
            for (int k = 0; k < kLanes; ++k)
                if (std::abs(residual[k]) < 256)  // others are clipped or padding
                    edges[size_t(place[k] / kSectors)].add(place[k] % kSectors, double(slope[k]),
                                                           double(residual[k]));
        }
    }
}

/// Adds the sectors within kReach of the set on the image of a circle.
Sectors dilate(Sectors sectors, const CircleImage& circle) {
    const double side = 2 * std::numbers::pi * std::sqrt(eigen(circle.shape).second) / kSectors;
    for (double reach = 0; reach < kReach; reach += side)
        sectors |= std::rotl(sectors, 1) | std::rotr(sectors, 1);
    return sectors;
}

}  // namespace

Sectors any_run(Sectors sectors) {
    if (!~sectors) return sectors;
    Sectors run = sectors & ~std::rotl(sectors, 1);  // where runs begin
    run &= ~run + 1;
    while (const Sectors next = std::rotl(run, 1) & sectors & ~run) run |= next;
    return run;
}

Pixel point_in_sector(const Parameters& p, int sector, double r) {
    const double angle = (sector + 0.5) * 2 * std::numbers::pi / kSectors;
    const double x = r * std::cos(angle), y = r * std::sin(angle);
    return {float(p[kX] + p[kAxx] * x + p[kAxy] * y), float(p[kY] + p[kAxy] * x + p[kAyy] * y)};
}

ROUNDEL_CLONES void remove_occluded(const OcclusionMask& occlusion, const Parameters& p, EdgePixels& pixels) {
    const SectorIndex index(p);
    int n = 0;
    for (int begin = 0; begin < pixels.used; begin += kLanes) {
        const Lanes x = load(pixels.x + begin), y = load(pixels.y + begin),
                    level = load(pixels.level + begin);
        const Bits place = index.locate(x, y);
        for (int k = 0; k < std::min(kLanes, pixels.used - begin); ++k) {
            const Sectors occluded = place[k] < kSectors ? occlusion.outer : occlusion.inner;
            if (occluded >> (place[k] % kSectors) & 1) continue;
            pixels.x[n] = x[k];
            pixels.y[n] = y[k];
            pixels.level[n++] = level[k];
        }
    }
    pixels.truncate(n);
}

void SectorSums::add(int sector, double slope, double residual) {
    const auto s = size_t(sector);
    const double w = std::abs(slope);
    rr_[s] += w * residual * residual;
    weight_[s] += w;
    squared_[s] += w * w;
    regression_[s] += slope * residual;
}

void SectorSums::append_mean_squares(std::vector<double>& to) const {
    for (size_t s = 0; s < kSectors; ++s)
        if (weight_[s] > 0) to.push_back(rr_[s] / weight_[s]);
}

Sectors SectorSums::exceeding(double noise, double slack) const {
    Sectors off = 0;
    for (size_t s = 0; s < kSectors; ++s) {
        const double chance = kUnlikely * std::sqrt(2 * squared_[s]);
        const double limit = noise * noise * (weight_[s] + chance) + slack * slack * weight_[s];
        off |= Sectors(rr_[s] > limit) << s;
    }
    return off;
}

Displacement SectorSums::displacement(double noise) const {
    constexpr int span = 2 * kAround + 1;
    const double least = kMinSeen * span / kSectors * std::accumulate(squared_.begin(), squared_.end(), 0.0);
    double sum = 0, chance = 0;
    int seen = 0;
    for (int s = 0; s < kSectors; ++s) {
        double across = 0, along = 0;
        for (int k = s - kAround; k <= s + kAround; ++k) {
            const auto at = size_t(k + kSectors) % kSectors;
            across += regression_[at];
            along += squared_[at];
        }
        if (along <= least) continue;
        sum += across * across / (along * along);
        chance += noise * noise / along;
        ++seen;
    }
    const double n = std::max(seen, 1);
    return {std::sqrt(sum / n), std::sqrt(chance / n)};
}

EdgeMisfit::EdgeMisfit(const ImageView& image, const Parameters& p, const Fields& fields)
    : p_(p), circles_{circle_image(p, 1), circle_image(p, p[kRatio])} {
    EdgePixels pixels;
    pixels.origin_x = int(std::lround(p[kX]));
    pixels.origin_y = int(std::lround(p[kY]));
    Parameters local = p;
    local[kX] -= pixels.origin_x;
    local[kY] -= pixels.origin_y;
    select_pixels(image, local, {kBand, kBand, true}, kPixels, pixels);
    mark_clipped(p[kBright], false, pixels);
    if (fields.any()) fields.remove_from(pixels);
    add_misfit(pixels, Model(local), SectorIndex(local), edges_);
}

double EdgeMisfit::median() const {
    std::vector<double> squares;
    for (const SectorSums& edge : edges_) edge.append_mean_squares(squares);
    if (squares.empty()) return 0;
    const auto middle = squares.begin() + ptrdiff_t(squares.size() / 2);
    std::nth_element(squares.begin(), middle, squares.end());
    return std::sqrt(*middle);
}

OcclusionMask EdgeMisfit::occlusion(double noise, double slack) const {
    return {dilate(edges_[0].exceeding(noise, slack), circles_[0]),
            dilate(edges_[1].exceeding(noise, slack), circles_[1])};
}

std::array<std::array<EdgeSlopes, kSectors>, 2> EdgeMisfit::edge_slopes() const {
    const double Axx = p_[kAxx], Axy = p_[kAxy], Ayy = p_[kAyy], det = Axx * Ayy - Axy * Axy;
    std::array<std::array<EdgeSlopes, kSectors>, 2> slopes;
    for (size_t s = 0; s < kSectors; ++s) {
        const double angle = (double(s) + 0.5) * 2 * std::numbers::pi / kSectors;
        const double u = std::cos(angle), v = std::sin(angle);
        // The edge's normal in the image, A^-1 (u, v), and the direction A (u, v) from the centre.
        const double nx = Ayy * u - Axy * v, ny = Axx * v - Axy * u,
                     n = std::copysign(std::hypot(nx, ny), det);
        const double outwards = det / n;
        for (const size_t edge : {0, 1}) {
            const double r = edge ? p_[kRatio] : 1, x = r * nx / n, y = r * ny / n;
            slopes[edge][s] = {nx / n,
                               ny / n,
                               x * u,
                               x * v + y * u,
                               y * v,
                               -r * r * u * outwards,
                               -r * r * v * outwards,
                               edge ? outwards : 0};
        }
    }
    return slopes;
}

double EdgeMisfit::correlation(double noise, const OcclusionMask& mask) const {
    using Matrix = std::array<EdgeSlopes, kEdgeParameters>;
    const auto slopes = edge_slopes();
    const Sectors masked[2] = {mask.outer, mask.inner};
    const auto each = [&](size_t first, size_t count, const auto& use) {
        for (const size_t edge : {0, 1})
            for (size_t s = first; s < first + count; ++s)
                if (!(masked[edge] >> s & 1)) use(slopes[edge][s], edges_[edge].score(s));
    };
    Matrix information{};
    EdgeSlopes right{};
    each(0, kSectors, [&](const EdgeSlopes& by, const SectorSums::Score& score) {
        for (size_t i = 0; i < kEdgeParameters; ++i) {
            right[i] += by[i] * score.sum;
            for (size_t j = 0; j <= i; ++j) information[i][j] += score.variance * by[i] * by[j];
        }
    });
    const Cholesky<kEdgeParameters> factor(information);
    if (!factor.positive()) return 1;
    const EdgeSlopes solution = factor.solve(right);
    double seen = 0, expected = 0;
    for (size_t first = 0; first < kSectors; first += kCluster) {
        EdgeSlopes sum{};
        Matrix share{};  // of the information, whitened: the clusters' add up to the unit matrix
        each(first, kCluster, [&](const EdgeSlopes& by, const SectorSums::Score& score) {
            double left = score.sum;  // of the score, after what the parameters absorb
            for (size_t i = 0; i < kEdgeParameters; ++i) left -= score.variance * by[i] * solution[i];
            const EdgeSlopes white = factor.halfway(by);
            for (size_t i = 0; i < kEdgeParameters; ++i) {
                sum[i] += white[i] * left;
                for (size_t j = 0; j < kEdgeParameters; ++j)
                    share[i][j] += score.variance * white[i] * white[j];
            }
        });
        for (size_t i = 0; i < kEdgeParameters; ++i) {
            seen += square(sum[i]);
            expected += share[i][i];
            for (size_t j = 0; j < kEdgeParameters; ++j) expected -= square(share[i][j]);
        }
    }
    return expected > 0 ? seen / (expected * square(noise)) : 1;
}

std::array<Displacement, 2> EdgeMisfit::displacements(double noise) const {
    return {edges_[0].displacement(noise), edges_[1].displacement(noise)};
}

}  // namespace roundel
