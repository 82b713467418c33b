// SPDX-License-Identifier: BSD-3-Clause
#include <nanobind/stl/tuple.h>

#include <algorithm>

#include "arrays.hpp"
#include "constellation.hpp"

namespace roundel::fusion {
namespace {

void make_cloud(MarkerCloud* self, const Positions& positions, const Rotations& covariances, double slack_m,
                double sigmas, double reach_m) {
    require_equal(positions.shape(0), {covariances.shape(0)});
    std::vector<Vector> points;
    std::vector<Matrix> variances;
    for (size_t k = 0; k < positions.shape(0); ++k) {
        points.push_back(vector_at(positions.data() + 3 * k));
        variances.push_back(matrix_at(covariances.data() + 9 * k));
    }
    new (self) MarkerCloud(std::move(points), std::move(variances), {slack_m, sigmas}, reach_m);
}

auto mappings_of(const MarkerCloud& cloud, const In<double, -1, -1>& distances, const In<bool, -1>& usable,
                 size_t max_steps, size_t max_mappings) {
    const size_t n = distances.shape(0);
    require_equal(n, {distances.shape(1)});
    require_equal(cloud.size(), {usable.size()});
    if (n < kMinMarkers) throw nb::value_error("a constellation has three markers or more");
    Mappings found;
    unlocked(
        [&] { found = find_mappings(cloud, distances.data(), n, usable.data(), {max_steps, max_mappings}); });
    auto [points, to] = make<int64_t>({found.points.size() / n, n});
    std::copy(found.points.begin(), found.points.end(), to);
    return std::make_tuple(points, found.complete);
}

}  // namespace

void bind_constellation(nb::module_& m) {
    nb::class_<MarkerCloud>(m, "MarkerCloud").def("__init__", &make_cloud).def("mappings", &mappings_of);
}

}  // namespace roundel::fusion
