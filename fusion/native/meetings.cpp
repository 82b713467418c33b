// SPDX-License-Identifier: BSD-3-Clause
#include "meetings.hpp"

#include <algorithm>

#include "../../camera_node/native/numeric/simd.hpp"

namespace roundel::fusion {
namespace {

struct Meeting {  // at a range along a ray, known to within `reach`
    double range, reach;
};
using Meetings = std::vector<std::vector<Meeting>>;  // by ray

/// One frame's rays, side by side.
struct Sheaf {
    std::vector<size_t> ray;
    std::vector<double> x, y, z;
    double reach = 0;  // the most, at their farthest
};

std::vector<Sheaf> sheaves_of(const Rays& rays, size_t n_frames) {
    std::vector<Sheaf> sheaves(n_frames);
    for (size_t k = 0; k < rays.n; ++k) {
        Sheaf& sheaf = sheaves[rays.frame[k]];
        const Vector& d = rays.direction[k];
        sheaf.ray.push_back(k);
        sheaf.x.push_back(d.x), sheaf.y.push_back(d.y), sheaf.z.push_back(d.z);
        sheaf.reach = std::max(sheaf.reach, rays.reach[k] * rays.farthest(k));
    }
    return sheaves;
}

/// Of a ray d and each of a sheaf: (w (d x e) / reach)^2 + (d e)^2 with `plane` = w x d / reach and w between
/// the centres. Below 1 they pass each other nearer than `reach`.
ROUNDEL_CLONES void measure_misses(const Sheaf& sheaf, const Vector& plane, const Vector& d, double* misses) {
    const double *x = sheaf.x.data(), *y = sheaf.y.data(), *z = sheaf.z.data();
    for (size_t k = 0; k < sheaf.ray.size(); ++k) {
        const double across = plane.x * x[k] + plane.y * y[k] + plane.z * z[k];
        const double along = d.x * x[k] + d.y * y[k] + d.z * z[k];
        misses[k] = across * across + along * along;
    }
}

/// Notes with both rays, of frames `a` and `b`, where they meet, if they do and both sizes agree.
void meet(const Rays& rays, size_t i, size_t j, const Viewpoint& a, const Viewpoint& b, Meetings& met) {
    const Vector &d = rays.direction[i], &e = rays.direction[j], w = a.centre - b.centre;
    const double c = dot(d, e), wd = dot(w, d), we = dot(w, e), parallax = 1 - c * c;
    const double s = (c * we - wd) / parallax, t = (we - c * wd) / parallax;
    if (!(parallax > kMinParallax && s > 0 && t > 0 && rays.fits(i, s) && rays.fits(j, t))) return;
    const Vector between = w + s * d - t * e;
    const double reach = std::hypot(rays.reach[i] * s, rays.reach[j] * t) + std::abs(a.moved - b.moved);
    if (!(dot(between, between) < reach * reach)) return;
    const double along = reach / std::sqrt(parallax);
    met[i].push_back({s, along}), met[j].push_back({t, along});
}

/// All rays of frame `a` with all of `b`: most are ruled out by how far they pass each other at the farthest.
void meet_all(const Rays& rays, const Sheaf& of_a, const Sheaf& of_b, const Viewpoint& a, const Viewpoint& b,
              Meetings& met) {
    const Vector w = a.centre - b.centre;
    const size_t n = of_b.ray.size();
    std::vector<double> misses(n);
    std::vector<size_t> near(n + 1);
    for (const size_t i : of_a.ray) {
        const double reach = rays.reach[i] * rays.farthest(i) + of_b.reach + std::abs(a.moved - b.moved);
        const Vector& d = rays.direction[i];
        measure_misses(of_b, (1 / reach) * cross(w, d), d, misses.data());
        size_t found = 0;
        for (size_t k = 0; k < n; ++k) near[found] = of_b.ray[k], found += misses[k] < 1;
        for (size_t k = 0; k < found; ++k) meet(rays, i, near[k], a, b, met);
    }
}

/// The mean of the meetings that agree with the one with which most do; among equals, with what is known
/// best.
double densest(std::vector<Meeting>& met) {
    std::sort(met.begin(), met.end(), [](const auto& a, const auto& b) { return a.range < b.range; });
    const auto at = [&](double range) {
        return std::lower_bound(met.begin(), met.end(), range,
                                [](const Meeting& m, double value) { return m.range < value; });
    };
    double highest = 0;
    auto first = met.begin(), last = met.begin();
    for (const auto& [range, reach] : met) {
        const auto from = at(range - reach), to = at(range + reach);
        const double weight = double(to - from) - reach / (1 + reach);
        if (weight > highest) highest = weight, first = from, last = to;
    }
    double sum = 0;
    for (auto m = first; m != last; ++m) sum += m->range;
    return sum / double(last - first);  // NaN without any
}

}  // namespace

bool Rays::fits(size_t ray, double range) const {
    for (const double* at = ranges + 2 * n_sizes * ray; at != ranges + 2 * n_sizes * (ray + 1); at += 2)
        if (at[0] < range && range < at[1]) return true;
    return false;
}

double Rays::farthest(size_t ray) const {
    double most = 0;
    for (size_t k = 0; k < n_sizes; ++k) most = std::max(most, ranges[2 * (n_sizes * ray + k) + 1]);
    return most;
}

std::vector<double> densest_ranges(const Rays& rays, const std::vector<Viewpoint>& frames) {
    const std::vector<Sheaf> sheaves = sheaves_of(rays, frames.size());
    Meetings met(rays.n);
    for (size_t a = 0; a < frames.size(); ++a)
        for (size_t b = a + 1; b < frames.size(); ++b)
            if (frames[a].camera != frames[b].camera)
                meet_all(rays, sheaves[a], sheaves[b], frames[a], frames[b], met);
    std::vector<double> ranges;
    for (auto& of_ray : met) ranges.push_back(densest(of_ray));
    return ranges;
}

}  // namespace roundel::fusion
