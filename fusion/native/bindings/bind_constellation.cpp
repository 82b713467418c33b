// SPDX-License-Identifier: BSD-3-Clause
#include <nanobind/stl/tuple.h>

#include <algorithm>

#include "arrays.hpp"
#include "constellation.hpp"

namespace roundel::fusion {
namespace {

using CameraVectors =
    In<double, -1, -1, 3>;  // by marker and camera; NaN where the camera did not see the marker

void make_cloud(MarkerCloud* self, const Positions& positions, const Rotations& covariances,
                const CameraVectors& to_cameras, double slack_m, double sigmas, double reach_m) {
    const size_t n = positions.shape(0), cameras = to_cameras.shape(1);
    require_equal(n, {covariances.shape(0), to_cameras.shape(0)});
    std::vector<CloudPoint> points;
    for (size_t k = 0; k < n; ++k) {
        points.push_back({vector_at(positions.data() + 3 * k), matrix_at(covariances.data() + 9 * k), {}});
        for (size_t c = 0; c < cameras; ++c) {
            const Vector to = vector_at(to_cameras.data() + 3 * (k * cameras + c));
            if (std::isfinite(dot(to, to))) points.back().to_cameras.push_back(to);
        }
    }
    new (self) MarkerCloud(std::move(points), {slack_m, sigmas}, reach_m);
}

auto mappings_of(const MarkerCloud& cloud, const In<double, -1, -1>& distances,
                 const In<double, -1, -1>& angles, const In<bool, -1>& usable, size_t max_steps,
                 size_t max_mappings) {
    const size_t n = distances.shape(0);
    require_equal(n, {distances.shape(1), angles.shape(0), angles.shape(1)});
    require_equal(cloud.size(), {usable.size()});
    if (n < kMinMarkers) throw nb::value_error("a constellation has three markers or more");
    Mappings found;
    const Constellation constellation{n, distances.data(), angles.data()};
    unlocked([&] { found = find_mappings(cloud, constellation, usable.data(), {max_steps, max_mappings}); });
    auto [points, to] = make<int64_t>({found.points.size() / n, n});
    std::copy(found.points.begin(), found.points.end(), to);
    return std::make_tuple(points, found.complete);
}

}  // namespace

void bind_constellation(nb::module_& m) {
    nb::class_<MarkerCloud>(m, "MarkerCloud").def("__init__", &make_cloud).def("mappings", &mappings_of);
}

}  // namespace roundel::fusion
