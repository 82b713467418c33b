// SPDX-License-Identifier: BSD-3-Clause
#include <nanobind/stl/tuple.h>

#include <algorithm>

#include "arrays.hpp"
#include "ray_intersections.hpp"

namespace roundel::fusion {
namespace {

using Viewpoints = std::vector<Viewpoint>;

/// `camera` is by frame, `centre` by camera.
void make_viewpoints(Viewpoints* self, const Index& camera, const Positions& centre) {
    below(centre.shape(0), camera);
    Viewpoints frames;
    for (size_t f = 0; f < camera.size(); ++f)
        frames.push_back({camera(f), vector_at(centre.data() + 3 * camera(f))});
    new (self) Viewpoints(std::move(frames));
}

using Ranges = In<double, -1, -1, 2>;

Rays rays_of(const Viewpoints& frames, const Index& frame, const Positions& direction, const Numbers& reach,
             const Numbers& moved, const Ranges& ranges) {
    const size_t n = frame.size();
    require_equal(n, {direction.shape(0), reach.size(), moved.size(), ranges.shape(0)});
    if (!ranges.shape(1)) throw nb::value_error("rays without ranges");
    return {below(frames.size(), frame),
            reinterpret_cast<const Vector*>(direction.data()),
            reach.data(),
            moved.data(),
            ranges.data(),
            n,
            ranges.shape(1)};
}

Out densest_ranges_of(const Viewpoints& frames, const Index& frame, const Positions& direction,
                      const Numbers& reach, const Numbers& moved, const Ranges& ranges) {
    const Rays rays = rays_of(frames, frame, direction, reach, moved, ranges);
    auto [found, to] = make({rays.n});
    unlocked([&, to = to] {
        const std::vector<double> densest = densest_ranges(rays, frames);
        std::copy(densest.begin(), densest.end(), to);
    });
    return found;
}

/// Rows (2, K) of the rays of each pair, and (2, K): the miss in tolerances, and the range on the first ray.
auto ray_pairs_of(const Viewpoints& frames, const Index& frame, const Positions& direction,
                  const Numbers& reach, const Numbers& moved, const Ranges& ranges, double most) {
    const Rays rays = rays_of(frames, frame, direction, reach, moved, ranges);
    std::vector<RayPair> found;
    unlocked([&] { found = ray_pairs(rays, frames, most); });
    auto [pairs, rows] = make<int64_t>({2, found.size()});
    auto [numbers, to] = make({2, found.size()});
    for (const RayPair& pair : found) {
        rows[0] = pair.first;
        rows[found.size()] = pair.second;
        ++rows;
        to[0] = pair.miss;
        to[found.size()] = pair.range;
        ++to;
    }
    return std::make_tuple(pairs, numbers);
}

}  // namespace

void bind_rays(nb::module_& m) {
    m.attr("MIN_PARALLAX") = kMinParallax;
    nb::class_<Viewpoints>(m, "Viewpoints").def("__init__", &make_viewpoints);
    m.def("densest_ranges", &densest_ranges_of);
    m.def("ray_pairs", &ray_pairs_of);
}

}  // namespace roundel::fusion
