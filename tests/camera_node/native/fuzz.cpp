// SPDX-License-Identifier: BSD-3-Clause
// Runs the detector on hostile images, for a build with sanitizers: `fuzz ROUNDS [SEED]`. Every image is in
// memory of exactly its size, so that the sanitizer reports reads beyond it. Exits with 1 if a result is
// impossible.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <memory>
#include <random>
#include <vector>

#include "detector.hpp"

namespace {

using Random = std::mt19937;

int between(Random& random, int low, int high) {
    return std::uniform_int_distribution<int>(low, high)(random);
}

/// An image whose last row ends with its memory; rows are `stride` bytes apart.
class Picture {
  public:
    Picture(int width, int height, int stride)
        : size_(height > 0 ? size_t(stride) * size_t(height - 1) + size_t(width) : 0),
          bytes_(new uint8_t[size_]()),
          view{bytes_.get(), width, height, stride} {}
    uint8_t& at(int x, int y) { return bytes_[size_t(y) * size_t(view.stride) + size_t(x)]; }

  private:
    size_t size_;
    std::unique_ptr<uint8_t[]> bytes_;

  public:
    const roundel::ImageView view;
};

template <typename Level>
void paint(Picture& picture, Level level) {
    for (int y = 0; y < picture.view.height; ++y)
        for (int x = 0; x < picture.view.width; ++x) picture.at(x, y) = uint8_t(level(x, y));
}

/// Rings of width `wide` around the centres of a grid: roundels of the smallest size, bullseyes, nested
/// rings.
void paint_rings(Picture& picture, int step, double wide, int rings) {
    paint(picture, [=](int x, int y) {
        const double r = std::hypot(x % step - step / 2.0, y % step - step / 2.0) / wide;
        return r < rings && int(r) % 2 == 1 ? 30 : 220;
    });
}

/// Strokes in all directions, like text.
void paint_strokes(Picture& picture, Random& random) {
    paint(picture, [](int, int) { return 220; });
    const int count = picture.view.width * picture.view.height / 30;
    for (int k = 0; k < count; ++k) {
        int x = between(random, 0, picture.view.width - 1), y = between(random, 0, picture.view.height - 1);
        const int dx = between(random, -1, 1), dy = between(random, -1, 1);
        for (int length = between(random, 1, 9); length > 0; --length, x += dx, y += dy)
            if (x >= 0 && y >= 0 && x < picture.view.width && y < picture.view.height) picture.at(x, y) = 30;
    }
}

void blur(Picture& picture) {
    const int w = picture.view.width, h = picture.view.height;
    for (int y = 0; y < h; ++y)
        for (int x = 1; x < w; ++x) picture.at(x, y) = uint8_t((picture.at(x - 1, y) + picture.at(x, y)) / 2);
    for (int y = 1; y < h; ++y)
        for (int x = 0; x < w; ++x) picture.at(x, y) = uint8_t((picture.at(x, y - 1) + picture.at(x, y)) / 2);
}

void paint_any(Picture& picture, Random& random) {
    const int kind = between(random, 0, 6), step = between(random, 6, 40);
    const double wide = step / double(between(random, 2, 12));
    if (kind == 0) paint(picture, [level = between(random, 0, 255)](int, int) { return level; });
    if (kind == 1) paint(picture, [&](int, int) { return between(random, 0, 255); });
    if (kind == 2) paint(picture, [&](int, int) { return 255 * between(random, 0, 1); });
    if (kind == 3) paint(picture, [=](int x, int y) { return (x / (step / 4) + y / (step / 4)) % 2 * 255; });
    if (kind == 4) paint_rings(picture, step, wide, between(random, 2, 12));
    if (kind == 5) paint_rings(picture, 2 * std::max(picture.view.width, picture.view.height), wide, 1 << 20);
    if (kind == 6) paint_strokes(picture, random);
    for (int passes = between(random, 0, 2); passes > 0; --passes) blur(picture);
}

bool is_possible(const roundel::RoundelFit& fit, const roundel::ImageView& image) {
    const auto positive = [](const roundel::Symmetric& m) { return m.xx > 0 && m.yy > 0 && m.det() > 0; };
    return fit.outer.x > -image.width && fit.outer.x < 2 * image.width && fit.outer.y > -image.height &&
           fit.outer.y < 2 * image.height && fit.outer.minor > 0 && fit.outer.major >= fit.outer.minor &&
           positive(fit.centre_covariance()) && positive(fit.offset_covariance()) && std::isfinite(fit.ratio);
}

/// Runs one detector, which tracks from image to image, on several images of one size or of several sizes.
bool survives(Random& random, bool by_paper) {
    roundel::RoundelLimits limits{.min_diameter = double(between(random, 6, 12)),
                                  .min_contrast = double(between(random, 5, 40))};
    roundel::Detector detector(limits, between(random, 0, 3) ? 1.0 : 0.1, by_paper);
    int width = between(random, 0, 90), height = between(random, 0, 90);
    for (int k = 0; k < 3; ++k) {
        if (!between(random, 0, 3)) {
            width = between(random, 0, 260);
            height = between(random, 0, 200);
        }
        Picture picture(width, height, width + between(random, 0, 1) * between(random, 0, 70));
        if (width && height) paint_any(picture, random);
        for (const auto& found : detector.detect(picture.view).roundels)
            if (!is_possible(found.fit, picture.view)) return false;
    }
    return true;
}

}  // namespace

int main(int argc, char** argv) {
    const int rounds = argc > 1 ? std::atoi(argv[1]) : 100, seed = argc > 2 ? std::atoi(argv[2]) : 1;
    for (int k = 0; k < rounds; ++k) {
        Random random(unsigned(seed + k));
        if (survives(random, k % 4 == 3)) continue;
        std::fprintf(stderr, "seed %d: impossible result\n", seed + k);
        return 1;
    }
    std::printf("%d rounds\n", rounds);
}
