// SPDX-License-Identifier: BSD-3-Clause
// Fuzzes the native core of fusion in a build with sanitizers: `fuzz ROUNDS [SEED]`. Every array has exactly
// its own size in memory, so that the sanitizer finds reads beyond its end. Indices and sizes are valid,
// because the bindings check them. Exits with 1 if a result refers to an element that does not exist.
#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <memory>
#include <random>
#include <stdexcept>

#include "candidates.hpp"
#include "inverse_lens.hpp"
#include "labelings.hpp"
#include "motion_model.hpp"
#include "ray_intersections.hpp"

namespace {

using namespace roundel::fusion;
using Numbers = std::vector<double>;
using Indices = std::vector<int64_t>;

class Random {
  public:
    explicit Random(unsigned seed) : engine_(seed) {}
    size_t below(size_t n) { return std::uniform_int_distribution<size_t>(0, n - 1)(engine_); }
    double normal() { return std::normal_distribution<double>()(engine_); }
    /// A normal number or, with the probability `wild`, a hostile one.
    double number(double scale, double wild) {
        constexpr double kNaN = std::numeric_limits<double>::quiet_NaN(),
                         kInfinity = std::numeric_limits<double>::infinity();
        constexpr double kHostile[] = {0,      -0.0,   kNaN, kInfinity, -kInfinity, 1e308,
                                       -1e308, 1e-320, 1e18, -1e18,     1e-9,       -1e-9};
        const bool is_wild = std::uniform_real_distribution<double>()(engine_) < wild;
        return is_wild ? kHostile[below(std::size(kHostile))] : scale * normal();
    }
    Numbers numbers(size_t n, double scale, double wild) {
        Numbers made(n);
        for (double& x : made) x = number(scale, wild);
        return made;
    }
    Indices indices(size_t n, size_t below_this) {
        Indices made(n);
        for (int64_t& k : made) k = int64_t(below(below_this));
        return made;
    }
    Vector vector(double scale, double wild) {
        return {number(scale, wild), number(scale, wild), number(scale, wild)};
    }
    Matrix matrix(double wild) { return {vector(1, wild), vector(1, wild), vector(1, wild)}; }
    ErrorMatrix square(double wild) {
        ErrorMatrix made{};
        for (int i = 0; i < kErrors; ++i)
            for (int j = 0; j < kErrors; ++j) made[i][j] = number(0.05, wild) + (i == j);
        return made;
    }

  private:
    std::mt19937 engine_;
};

FramePoses poses_of(Random& random, size_t bodies, size_t frames, double wild) {
    std::vector<Body> all;
    for (size_t b = 0; b < bodies; ++b)
        all.push_back({rotation_from_vector(random.vector(1, wild)), random.vector(1, wild),
                       random.vector(3, wild), random.vector(2, wild)});
    std::vector<Exposure> exposures;
    for (size_t f = 0; f < frames; ++f)
        exposures.push_back({rotation_from_vector(random.vector(1, wild)), random.vector(3, wild),
                             random.number(0.01, wild), random.number(0.01, wild)});
    return {all, exposures};
}

/// Views, equations, sums and residuals of discs; then the prediction of the bodies.
bool estimate(Random& random, double wild) {
    const size_t bodies = 1 + random.below(6), frames = 1 + random.below(4), n = random.below(40);
    const FramePoses poses = poses_of(random, bodies, frames, wild);
    const Indices frame = random.indices(n, frames), body = random.indices(n, bodies);
    const Numbers marker = random.numbers(3 * n, 0.2, wild), normal = random.numbers(3 * n, 1, wild),
                  radius = random.numbers(n, 0.05, wild), delay = random.numbers(n, 0.01, wild);
    const Discs discs{frame.data(),       body.data(),   {marker.data(), n},
                      {normal.data(), n}, radius.data(), delay.data()};
    Numbers views(11 * n);
    view_discs(poses, discs, views.data());
    const Numbers xy = random.numbers(2 * n, 1, wild), four = random.numbers(4 * n, 800, wild),
                  axes = random.numbers(2 * n, 20, wild), one = random.numbers(n, 1, wild);
    const std::unique_ptr<bool[]> single(new bool[bodies]());
    std::vector<Equations> rows(n), outlines(n);
    const CentreObservations centres{discs, {xy.data(), n}, {four.data(), n}, single.get()};
    const OutlineObservations seen{discs, {axes.data(), n}, one.data(), {four.data(), n}, one.data()};
    for (size_t k = 0; k < n; ++k) {
        rows[k] = linearize(poses, centres, k);
        outlines[k] = linearize(poses, seen, k);
    }
    std::vector<ErrorMatrix> H(bodies);
    std::vector<ErrorVector> g(bodies);
    for (size_t b = 0; b < bodies; ++b) {
        H[b] = random.square(wild);
        g[b][0] = random.number(1, wild);
    }
    Numbers weights(n, 1);
    const EquationSystem system{rows.data(), body.data(), n, bodies};
    reweigh(system, H.data(), g.data(), weights.data());
    const Numbers steps = random.numbers(bodies * kErrors, 0.1, wild);
    Numbers left(2 * n);
    residuals(system, steps.data(), left.data());
    for (size_t b = 0; b < bodies; ++b) {
        Body moving{rotation_from_vector(random.vector(1, wild)), random.vector(1, wild),
                    random.vector(1, wild), random.vector(1, wild)};
        predict(moving, H[b], {random.number(0.01, wild), random.number(1, wild), 1, b % 2 == 0});
        try {
            inverse(H[b]);
        } catch (const std::runtime_error&) {  // RuntimeError in Python
        }
    }
    return true;
}

/// Candidates are pairs of existing elements, none of them twice.
bool associate(Random& random, double wild) {
    const size_t bodies = 1 + random.below(5), frames = 1 + random.below(4), n = random.below(80);
    const FramePoses poses = poses_of(random, bodies, frames, wild);
    std::vector<ExpectedMarker> markers;
    for (size_t k = random.below(20); k > 0; --k) {
        const ErrorMatrix P = random.square(wild);
        const DiscOnBody disc{random.vector(0.2, wild), random.vector(1, wild), random.number(0.05, wild)};
        markers.push_back(
            ExpectedMarker::of(int64_t(random.below(bodies)), disc, random.matrix(wild), P[0].data()));
    }
    Indices frame = random.indices(n, frames);
    std::sort(frame.begin(), frame.end());
    const Numbers xy = random.numbers(2 * n, 0.4, wild), scale = random.numbers(4 * n, 800, wild),
                  cov = random.numbers(4 * n, 1, wild), major = random.numbers(n, 20, wild),
                  focal = random.numbers(frames, 800, wild), delay = random.numbers(n, 0.01, wild);
    const Detections seen{frame.data(),    {xy.data(), n}, {scale.data(), n},
                          {cov.data(), n}, major.data(),   delay.data()};
    const std::vector<Candidate> pairs = find_candidates(poses, ExpectedMarkers(markers), seen, focal.data());
    std::vector<char> found(n * markers.size());
    for (const Candidate& pair : pairs) {
        char& before = found.at(size_t(pair.detection) * markers.size() + size_t(pair.marker));
        if (before || !std::isfinite(pair.cost)) return false;
        before = 1;
    }
    return true;
}

/// Labelings have existing pairs without a common marker or detection, and not fewer than the least.
bool label(Random& random, double wild) {
    const size_t n = random.below(30);
    Indices marker = random.indices(n, 6);
    std::sort(marker.begin(), marker.end());
    const Indices detection = random.indices(n, 5);
    const Numbers cost = random.numbers(n, 9, wild);
    const int64_t least = int64_t(random.below(4));
    for (const Labeling& one :
         find_labelings({marker.data(), detection.data(), cost.data(), n}, least, 5, {2000, 64})) {
        std::vector<char> markers(6), detections(5);
        for (const int64_t k : one.pairs)
            if (markers.at(size_t(marker.at(size_t(k))))++ || detections.at(size_t(detection[size_t(k)]))++)
                return false;
        if (int64_t(one.pairs.size()) < least) return false;
    }
    return true;
}

/// The densest range of a ray is a possible one, or NaN; pairs are of rays that miss each other by little.
bool intersect(Random& random, double wild) {
    const size_t frames = 1 + random.below(5), n = random.below(60), sizes = 1 + random.below(3);
    std::vector<Viewpoint> viewpoints;
    for (size_t f = 0; f < frames; ++f)
        viewpoints.push_back({int64_t(random.below(3)), random.vector(3, wild)});
    const Indices frame = random.indices(n, frames);
    std::vector<Vector> directions;
    for (size_t k = 0; k < n; ++k) {
        const Vector d = random.vector(1, wild);
        directions.push_back((1 / std::sqrt(dot(d, d))) * d);
    }
    const Numbers reach = random.numbers(n, 0.1, wild), limits = random.numbers(2 * n * sizes, 9, wild),
                  moved = random.numbers(n, 0.01, wild);
    const Rays rays{frame.data(), directions.data(), reach.data(), moved.data(), limits.data(), n, sizes};
    const std::vector<double> ranges = densest_ranges(rays, viewpoints);
    for (size_t k = 0; k < n; ++k)
        if (std::isfinite(ranges[k]) && !(ranges[k] > 0 && ranges[k] <= rays.max_range(k) * (1 + 1e-9)))
            return false;
    for (const RayPair& pair : ray_pairs(rays, viewpoints, 3))
        if (!(pair.first >= 0 && pair.second < int64_t(n) && pair.miss < 3 && pair.range > 0)) return false;
    return ranges.size() == n;
}

bool undistort(Random& random, double wild) {
    const size_t columns = 1 + random.below(4), rows = 1 + random.below(4), n = random.below(30);
    const Numbers cells = random.numbers(20 * (columns + 2) * (rows + 2), 1, wild);
    const Numbers uv = random.numbers(2 * n, 100, wild), axes = random.numbers(2 * n, 30, wild),
                  angle = random.numbers(n, 1, wild);
    Numbers xy(2 * n), scale(4 * n);
    const Outlines seen{{uv.data(), n}, {axes.data(), n}, angle.data()};
    look_up({cells.data(), int64_t(columns), int64_t(rows), 32}, seen, xy.data(), scale.data());
    return true;
}

}  // namespace

int main(int argc, char** argv) {
    const int rounds = argc > 1 ? std::atoi(argv[1]) : 100;
    Random random(argc > 2 ? unsigned(std::atoi(argv[2])) : 1);
    for (int round = 0; round < rounds; ++round) {
        const double wild = round % 4 == 0 ? 0 : 0.3 / (round % 4 * round % 4 + 1);
        if (!estimate(random, wild) || !associate(random, wild) || !label(random, wild) ||
            !intersect(random, wild) || !undistort(random, wild)) {
            std::fprintf(stderr, "round %d: impossible result\n", round);
            return 1;
        }
    }
    return 0;
}
