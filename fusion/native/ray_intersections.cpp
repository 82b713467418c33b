// SPDX-License-Identifier: BSD-3-Clause
#include "ray_intersections.hpp"

#include <algorithm>

#include "numeric/simd.hpp"

namespace roundel::fusion {
namespace {

struct Intersection {
    double range;  // along one ray
    double reach;  // tolerance of the range
};
using Intersections = std::vector<std::vector<Intersection>>;  // by ray

/// The rays of one frame, by columns.
struct FrameRays {
    std::vector<size_t> ray;
    std::vector<double> x, y, z;
    double reach = 0;     // largest tolerance, at the largest range
    double earliest = 0;  // of `Rays::moved`
    double latest = 0;    // of `Rays::moved`

    /// The largest motion between a ray and one of these.
    double most_moved(double moved) const { return std::max(moved - earliest, latest - moved); }
};

std::vector<FrameRays> rays_by_frame(const Rays& rays, size_t n_frames) {
    std::vector<FrameRays> by_frame(n_frames);
    for (size_t k = 0; k < rays.n; ++k) {
        FrameRays& of_frame = by_frame[rays.frame[k]];
        const Vector& d = rays.direction[k];
        const bool is_first = of_frame.ray.empty();
        of_frame.earliest = is_first ? rays.moved[k] : std::min(of_frame.earliest, rays.moved[k]);
        of_frame.latest = is_first ? rays.moved[k] : std::max(of_frame.latest, rays.moved[k]);
        of_frame.ray.push_back(k);
        of_frame.x.push_back(d.x);
        of_frame.y.push_back(d.y);
        of_frame.z.push_back(d.z);
        of_frame.reach = std::max(of_frame.reach, rays.reach[k] * rays.max_range(k));
    }
    return by_frame;
}

/// For a ray d and each ray e of a frame: (w (d x e) / reach)^2 + (d e)^2, with w between the centres and
/// `plane` = w x d / reach. Values below 1 are rays that pass each other within `reach`.
ROUNDEL_CLONES void measure_misses(const FrameRays& of_frame, const Vector& plane, const Vector& d,
                                   double* misses) {
    const double *x = of_frame.x.data(), *y = of_frame.y.data(), *z = of_frame.z.data();
    for (size_t k = 0; k < of_frame.ray.size(); ++k) {
        const double across = plane.x * x[k] + plane.y * y[k] + plane.z * z[k];
        const double along = d.x * x[k] + d.y * y[k] + d.z * z[k];
        misses[k] = across * across + along * along;
    }
}

/// Two rays i and j that pass each other: their ranges s and t, the distance between them and its tolerance,
/// and the squared sine of the angle between them.
struct Passing {
    size_t i, j;
    double s, t, distance, reach, parallax;
};

/// Intersects two frames of different cameras; `To` receives each `Passing` within `most` tolerances.
template <class To>
class FramePair {
  public:
    FramePair(const Rays& rays, const Viewpoint& a, const Viewpoint& b, double most, To& to)
        : rays_(rays), baseline_(a.centre - b.centre), most_(most), to_(to) {}

    /// All rays of `of_a` with all of `of_b`. Most pairs pass each other too far away at any range.
    void intersect(const FrameRays& of_a, const FrameRays& of_b) {
        const size_t n = of_b.ray.size();
        std::vector<double> misses(n);
        std::vector<size_t> near(n + 1);
        for (const size_t i : of_a.ray) {
            const double moved = of_b.most_moved(rays_.moved[i]);
            const double reach = most_ * (rays_.reach[i] * rays_.max_range(i) + of_b.reach + moved);
            const Vector& d = rays_.direction[i];
            measure_misses(of_b, (1 / reach) * cross(baseline_, d), d, misses.data());
            size_t found = 0;
            for (size_t k = 0; k < n; ++k) {
                near[found] = of_b.ray[k];
                found += misses[k] < 1;
            }
            for (size_t k = 0; k < found; ++k) pass(i, near[k]);
        }
    }

  private:
    /// Reports rays i and j if they pass each other at ranges that both sizes allow.
    void pass(size_t i, size_t j) {
        const Vector &d = rays_.direction[i], &e = rays_.direction[j], &w = baseline_;
        const double c = dot(d, e), wd = dot(w, d), we = dot(w, e), parallax = 1 - c * c;
        const double s = (c * we - wd) / parallax, t = (we - c * wd) / parallax;
        if (!(parallax > kMinParallax && s > 0 && t > 0 && rays_.allows(i, s) && rays_.allows(j, t))) return;
        const Vector between = w + s * d - t * e;
        const double moved = std::abs(rays_.moved[i] - rays_.moved[j]);
        const double reach = std::hypot(rays_.reach[i] * s, rays_.reach[j] * t) + moved;
        const double distance = std::sqrt(dot(between, between));
        if (distance < most_ * reach) to_({i, j, s, t, distance, reach, parallax});
    }

    const Rays& rays_;
    const Vector baseline_;
    const double most_;
    To& to_;
};

/// All rays of different cameras that pass each other within `most` tolerances.
template <class To>
void intersect_all(const Rays& rays, const std::vector<Viewpoint>& frames, double most, To to) {
    const std::vector<FrameRays> by_frame = rays_by_frame(rays, frames.size());
    for (size_t a = 0; a < frames.size(); ++a)
        for (size_t b = a + 1; b < frames.size(); ++b)
            if (frames[a].camera != frames[b].camera)
                FramePair<To>(rays, frames[a], frames[b], most, to).intersect(by_frame[a], by_frame[b]);
}

/// The mean of the intersections that agree with the one that has most agreement; of equals, with the one of
/// the smallest tolerance.
double densest(std::vector<Intersection>& on_ray) {
    std::sort(on_ray.begin(), on_ray.end(), [](const auto& a, const auto& b) { return a.range < b.range; });
    const auto at = [&](double range) {
        return std::lower_bound(on_ray.begin(), on_ray.end(), range,
                                [](const Intersection& m, double value) { return m.range < value; });
    };
    double highest = 0;
    auto first = on_ray.begin(), last = on_ray.begin();
    for (const auto& [range, reach] : on_ray) {
        const auto from = at(range - reach), to = at(range + reach);
        const double weight = double(to - from) - reach / (1 + reach);
        if (weight > highest) {
            highest = weight;
            first = from;
            last = to;
        }
    }
    double sum = 0;
    for (auto m = first; m != last; ++m) sum += m->range;
    return sum / double(last - first);  // NaN without intersections
}

}  // namespace

bool Rays::allows(size_t ray, double range) const {
    for (const double* at = ranges + 2 * n_sizes * ray; at != ranges + 2 * n_sizes * (ray + 1); at += 2)
        if (at[0] < range && range < at[1]) return true;
    return false;
}

double Rays::max_range(size_t ray) const {
    double most = 0;
    for (size_t k = 0; k < n_sizes; ++k) most = std::max(most, ranges[2 * (n_sizes * ray + k) + 1]);
    return most;
}

std::vector<double> densest_ranges(const Rays& rays, const std::vector<Viewpoint>& frames) {
    Intersections found(rays.n);
    intersect_all(rays, frames, 1, [&](const Passing& at) {
        const double along = at.reach / std::sqrt(at.parallax);
        found[at.i].push_back({at.s, along});
        found[at.j].push_back({at.t, along});
    });
    std::vector<double> ranges;
    for (auto& on_ray : found) ranges.push_back(densest(on_ray));
    return ranges;
}

std::vector<RayPair> ray_pairs(const Rays& rays, const std::vector<Viewpoint>& frames, double most) {
    std::vector<RayPair> pairs;
    intersect_all(rays, frames, most, [&](const Passing& at) {
        pairs.push_back({int64_t(at.i), int64_t(at.j), at.distance / at.reach, at.s});
    });
    return pairs;
}

}  // namespace roundel::fusion
