// SPDX-License-Identifier: BSD-3-Clause
#include "occlusion.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>

namespace roundel {

namespace {

constexpr double kBand = 2;    // pixels on either side of an edge
constexpr int kPixels = 1500;  // that are looked at, about
constexpr double kChance = 4;  // standard deviations
constexpr double kReach = 2;   // pixels to which a cover's edge is blurred

/// The direction of (x, y), radians from -pi to pi, to 4e-4: a polynomial in the tangent, or in its inverse,
/// takes a sixth of the time of the exact one.
float direction(float x, float y) {
    const float across = std::abs(x), up = std::abs(y),
                t = std::min(across, up) / std::max({across, up, 1e-9f});
    const float tt = t * t;
    float angle = t + t * tt * (-0.327622764f + tt * (0.15931422f - tt * 0.0464964749f));
    if (up > across) angle = float(std::numbers::pi / 2) - angle;
    if (x < 0) angle = float(std::numbers::pi) - angle;
    return y < 0 ? -angle : angle;
}

/// Which edge a pixel belongs to, and which sector of it.
class Compass {
  public:
    explicit Compass(const Parameters& p)
        : x_(float(p[kX])), y_(float(p[kY])), between_(float(square((1 + p[kRatio]) / 2))) {
        const double det = p[kAxx] * p[kAyy] - p[kAxy] * p[kAxy];
        xx_ = float(p[kAyy] / det), xy_ = float(-p[kAxy] / det), yy_ = float(p[kAxx] / det);
    }
    struct Place {
        bool inner;
        int sector;
    };
    Place locate(float x, float y) const {
        const float dx = x - x_, dy = y - y_, qx = xx_ * dx + xy_ * dy, qy = xy_ * dx + yy_ * dy;
        const float turn = direction(qx, qy) * float(kSectors / (2 * std::numbers::pi));
        return {qx * qx + qy * qy < between_, int(turn + kSectors) % kSectors};
    }

  private:
    static double square(double x) { return x * x; }
    float x_, y_, between_, xx_, xy_, yy_;
};

/// Squared residuals on an edge of the ring by sector, each with the squared slope as its weight.
struct Misfit {
    std::array<double, kSectors> rr{}, weight{}, squared{};
    void add(int sector, double w, double r) {
        const auto s = size_t(sector);
        rr[s] += w * r * r, weight[s] += w, squared[s] += w * w;
    }
    /// The sectors whose mean is more than `noise` and `slack` explain, but for a chance of four sigmas.
    Sectors beyond(double noise, double slack) const {
        Sectors off = 0;
        for (size_t s = 0; s < kSectors; ++s) {
            const double chance = kChance * std::sqrt(2 * squared[s]);
            const double limit = noise * noise * (weight[s] + chance) + slack * slack * weight[s];
            off |= Sectors(rr[s] > limit) << s;
        }
        return off;
    }
};

/// Of the outer edge and of the inner one.
std::array<Misfit, 2> misfit_by_sector(const EdgePixels& pixels, const Parameters& p) {
    const Model model(p);
    const Compass compass(p);
    std::array<Misfit, 2> misfit;
    Gradient at;
    for (int begin = 0; begin < pixels.used; begin += kLanes) {
        model.evaluate(pixels.x + begin, pixels.y + begin, pixels.level + begin, 1, at);
        for (int k = 0; k < std::min(kLanes, pixels.used - begin); ++k) {
            const auto [inner, sector] = compass.locate(pixels.x[begin + k], pixels.y[begin + k]);
            if (std::abs(at.residual[0][k]) < 256)  // others are clipped
                misfit[inner].add(sector, double(std::abs(at.ring[0][k])), double(at.residual[0][k]));
        }
    }
    return misfit;
}

/// The set with all sectors that lie within kReach of it on the image of a circle.
Sectors widen(Sectors sectors, const CircleImage& circle) {
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

void leave_out(const Hidden& hidden, const Parameters& p, EdgePixels& pixels) {
    const Compass compass(p);
    int kept = 0;
    for (int k = 0; k < pixels.used; ++k) {
        const auto [inner, sector] = compass.locate(pixels.x[k], pixels.y[k]);
        if ((inner ? hidden.inner : hidden.outer) >> sector & 1) continue;
        pixels.x[kept] = pixels.x[k], pixels.y[kept] = pixels.y[k], pixels.level[kept++] = pixels.level[k];
    }
    pixels.expected -= pixels.used - kept;
    pixels.used = kept;
    pixels.fill_up();
}

Hidden find_hidden(const ImageView& image, const Parameters& p, double noise, double slack) {
    EdgePixels pixels;
    pixels.origin_x = int(std::lround(p[kX])), pixels.origin_y = int(std::lround(p[kY]));
    Parameters local = p;
    local[kX] -= pixels.origin_x, local[kY] -= pixels.origin_y;
    select_pixels(image, local, {kBand, kBand, true}, kPixels, pixels);
    const auto [outer, inner] = misfit_by_sector(pixels, local);
    return {widen(outer.beyond(noise, slack), circle_image(local, 1)),
            widen(inner.beyond(noise, slack), circle_image(local, local[kRatio]))};
}

}  // namespace roundel
