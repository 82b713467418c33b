// SPDX-License-Identifier: BSD-3-Clause
#include "fit/fields.hpp"

#include <algorithm>
#include <cmath>

#include "numeric/simd.hpp"

namespace roundel {

namespace {

constexpr float kDarkest = 0.6f;     // of the levels that are not clipped
constexpr float kBrightest = 254;    // of the levels that are not clipped
constexpr float kLeastLight = 0.2f;  // of the mean
constexpr double kEdgeBlurs = 1.5;   // from the card's edge to where the ground hardly shows

ROUNDEL_CLONES void remove(const FieldPlane& plane, const float* of, float along_x, float along_y,
                           EdgePixels& pixels) {
    for (int k = 0; k < pixels.count; k += kLanes) {
        const Lanes x = load(pixels.x + k), y = load(pixels.y + k), level = load(pixels.level + k);
        Lanes X = x, Y = y, f[kLightFields], light = all(1), gloss{};
        plane.map(X, Y);
        functions_of_light(X, Y, f);
        for (int i = 0; i < kLightFields; ++i) {
            light += of[kLight + i] * f[i];
            gloss += of[kGloss + i] * f[i];
        }
        const Lanes least = light > kLeastLight ? light : all(kLeastLight);
        const Lanes even = clamped((level - gloss) / least, all(kDarkest), all(kBrightest));
        const Bits clipped = (level < 0.5f) | (level > kSaturated);
        const Lanes bend = 2.0f * (of[kBend] * f[2] + of[kBend + 1] * f[3]);
        store(pixels.level + k, clipped ? level : even);
        store(pixels.x + k, x - along_x * bend);
        store(pixels.y + k, y - along_y * bend);
    }
}

}  // namespace

FieldFrame::FieldFrame(const Parameters& p) : x(p[kX]), y(p[kY]) {
    const Eigen axes = eigen({p[kAxx], p[kAxy], p[kAyy]});
    major = axes.first;
    minor = axes.second;
    cos = -std::sin(axes.angle);
    sin = std::cos(axes.angle);
    reach = std::max((1 + p[kCard]) / 2, p[kCard] - kEdgeBlurs * p[kBlur] / minor);
}

double FieldFrame::tilt() const { return std::sqrt(std::max(0.0, square(major / minor) - 1)); }

bool Fields::any() const {
    return std::any_of(of.begin(), of.end(), [](double coefficient) { return coefficient != 0; });
}

bool Fields::has_light() const {
    return std::any_of(of.begin(), of.begin() + kBend, [](double coefficient) { return coefficient != 0; });
}

double Fields::bend() const { return std::hypot(of[kBend], of[kBend + 1]); }

double Fields::even_level(double x, double y, double level) const {
    if (!has_light()) return level;
    const double dx = x - frame.x, dy = y - frame.y;
    const double X = (frame.cos * dx + frame.sin * dy) / frame.minor,
                 Y = (frame.cos * dy - frame.sin * dx) / frame.major;
    double f[kLightFields], light = 1, gloss = 0;
    functions_of_light(X, Y, f);
    for (size_t i = 0; i < kLightFields; ++i) {
        light += of[kLight + i] * f[i];
        gloss += of[kGloss + i] * f[i];
    }
    return (level - gloss) / std::max(light, double(kLeastLight));
}

void Fields::remove_from(EdgePixels& pixels) const {
    FieldFrame local = frame;
    local.x -= pixels.origin_x;
    local.y -= pixels.origin_y;
    float coefficients[kFields];
    std::transform(of.begin(), of.end(), coefficients, [](double value) { return float(value); });
    remove(FieldPlane(local), coefficients, float(frame.minor * frame.cos), float(frame.minor * frame.sin),
           pixels);
}

}  // namespace roundel
