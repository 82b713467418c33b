// SPDX-License-Identifier: BSD-3-Clause
#include <algorithm>

#include "arrays.hpp"
#include "meetings.hpp"

namespace roundel::fusion {
namespace {

std::vector<Viewpoint> viewpoints_of(const Index& camera, const In<double, -1, 3>& centre,
                                     const Numbers& moved) {
    require_equal(camera.size(), {moved.size()});
    below(centre.shape(0), camera);
    std::vector<Viewpoint> frames;
    for (size_t f = 0; f < camera.size(); ++f)
        frames.push_back({camera(f), vector_at(centre.data() + 3 * camera(f)), moved(f)});
    return frames;
}

/// `centre` is of each camera, `camera` and `moved` of each frame, the rest of each ray.
Out ranges_of(const Index& camera, const In<double, -1, 3>& centre, const Numbers& moved, const Index& frame,
              const In<double, -1, 3>& direction, const Numbers& reach, const In<double, -1, -1, 2>& ranges) {
    const size_t n = frame.size();
    require_equal(n, {direction.shape(0), reach.size(), ranges.shape(0)});
    if (!ranges.shape(1)) throw nb::value_error("rays without ranges");
    const std::vector<Viewpoint> frames = viewpoints_of(camera, centre, moved);
    const Rays rays{below(frames.size(), frame),
                    reinterpret_cast<const Vector*>(direction.data()),
                    reach.data(),
                    ranges.data(),
                    n,
                    ranges.shape(1)};
    auto [found, to] = make({n});
    unlocked([&, to = to] {
        const std::vector<double> densest = densest_ranges(rays, frames);
        std::copy(densest.begin(), densest.end(), to);
    });
    return found;
}

}  // namespace

void bind_rays(nb::module_& m) {
    m.attr("MIN_PARALLAX") = kMinParallax;
    m.def("densest_ranges", &ranges_of);
}

}  // namespace roundel::fusion
