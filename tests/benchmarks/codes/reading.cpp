// SPDX-License-Identifier: BSD-3-Clause
/// Prints the microseconds in which a roundel's code is read, by diameter in pixels: of a coded one, of one
/// with so little contrast that all codes are compared, and of a plain one on even ground and on a pattern of
/// tiles.
#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <numbers>
#include <random>
#include <vector>

#include "code/code_reader.hpp"

using namespace roundel;

constexpr int kSide = 256, kReads = 1000, kRepetitions = 60, kWhite = 190, kGrey = 90;
constexpr int kBlack = 40, kFaint = 182;  // ink
constexpr double kMiddlePixel = 128;

double level(double x, double y, double radius, Word word, int ink, bool tiles) {
    const double r = std::hypot(x, y) / radius, turn = std::atan2(-y, x) / (2 * std::numbers::pi) + 1;
    if (r < 1) return r < 0.6 ? kWhite : ink;
    if (r > kCodeInner && r < kCodeOuter && (word >> int(turn * kCodeSectors) % kCodeSectors & 1)) return ink;
    if (r < (word ? 1.9 : 9.0 / 7)) return kWhite;
    return tiles && (int(x + kSide) / 9 + int(y + kSide) / 7) % 2 ? kWhite : kGrey;
}

double microseconds(double diameter, Word word, int ink, bool tiles) {
    std::vector<uint8_t> pixels;
    std::mt19937 random(1);
    std::normal_distribution<double> noise(0, 3);
    for (int y = 0; y < kSide; ++y)
        for (int x = 0; x < kSide; ++x) {
            const double seen = level(x - kMiddlePixel, y - kMiddlePixel, diameter / 2, word, ink, tiles);
            pixels.push_back(uint8_t(std::clamp(seen + noise(random), 0.0, 255.0)));
        }
    RoundelFit fit{};
    fit.outer = {kMiddlePixel, kMiddlePixel, diameter, diameter, 0};
    fit.p[kX] = fit.p[kY] = kMiddlePixel;
    fit.p[kAxx] = fit.p[kAyy] = diameter / 2;
    fit.p[kBright] = kWhite;
    fit.p[kDark] = ink;
    fit.p[kBlur] = 0.6;
    fit.noise = 3;
    for (size_t k = 0; k < kPoseCount; ++k) fit.pose_cov[k][k] = 1e-4;
    CodeTrack track;
    double best = 1e9;
    for (int k = 0; k < kRepetitions; ++k) {
        const auto start = std::chrono::steady_clock::now();
        for (int n = 0; n < kReads; ++n) track.add({pixels.data(), kSide, kSide, kSide}, fit);
        const std::chrono::duration<double, std::micro> took = std::chrono::steady_clock::now() - start;
        best = std::min(best, took.count() / kReads);
    }
    return best;
}

int main() {
    for (const double diameter : {12.0, 20.0, 30.0, 40.0, 60.0, 100.0})
        std::printf("%g %.2f %.2f %.2f %.2f\n", diameter,
                    microseconds(diameter, code_words()[20], kBlack, false),
                    microseconds(diameter, code_words()[20], kFaint, false),
                    microseconds(diameter, 0, kBlack, false), microseconds(diameter, 0, kBlack, true));
}
