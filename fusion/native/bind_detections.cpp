// SPDX-License-Identifier: BSD-3-Clause
#include <nanobind/stl/tuple.h>

#include <algorithm>

#include "arrays.hpp"
#include "assignment.hpp"
#include "inverse_lens.hpp"

namespace roundel::fusion {
namespace {

using Markers = std::vector<ExpectedMarker>;
constexpr size_t kMostMarkers = size_t(1) << 24;  // a number beyond is none of an arena's

/// R and P are those of the bodies, `body` that of each marker.
void make_expected(Markers* self, const In<double, -1, 3, 3>& R, const In<double, -1, 12, 12>& P,
                   const Index& body, const Vectors& marker, const Numbers& radius) {
    const size_t n = body.size();
    require_equal(R.shape(0), {P.shape(0)});
    require_equal(n, {radius.size()});
    below(R.shape(0), body);
    const auto places = columns<3>(marker, n);
    Markers markers;
    for (size_t k = 0; k < n; ++k)
        markers.push_back(ExpectedMarker::of(body(k), places.vector(k), radius(k),
                                             matrix_at(R.data() + 9 * body(k)), P.data() + 144 * body(k)));
    new (self) Markers(std::move(markers));
}

Out covariances(const Markers& markers, double tau) {
    auto [all, to] = make({markers.size(), 3, 3});
    for (const ExpectedMarker& marker : markers) {
        write(marker.covariance(tau), to);
        to += 9;
    }
    return all;
}

auto candidates(const Markers& markers, const Poses& poses, const Index& frame, const Pairs& xy,
                const Matrices2& scale, const Matrices2& cov, const Numbers& major, const Numbers& focal) {
    const size_t n = frame.size();
    below(poses.exposures().size(), frame);
    require_equal(n, {major.size()});
    require_equal(poses.exposures().size(), {focal.size()});
    for (const ExpectedMarker& marker : markers) require_below(poses.n_bodies(), marker.body);
    const Detections seen{frame.data(), columns<2>(xy, n), columns<4>(scale, n), columns<4>(cov, n),
                          major.data()};
    std::vector<Candidate> found;
    unlocked([&] { found = find_candidates(poses, markers, seen, focal.data()); });
    auto [pairs, rows] = make<int64_t>({2, found.size()});
    auto [costs, to] = make({found.size()});
    for (const Candidate& pair : found) {
        rows[found.size()] = pair.detection, *rows++ = pair.marker;
        *to++ = pair.cost;
    }
    return std::make_tuple(pairs, costs);
}

OutOf<int64_t> assign_pairs(const In<int64_t, 2, -1>& pairs, const Numbers& costs, const Index& frame) {
    const size_t n = costs.size();
    require_equal(n, {pairs.shape(1)});
    std::vector<Candidate> candidates;
    for (size_t k = 0; k < n; ++k) {
        require_below(kMostMarkers, pairs(0, k));
        require_below(frame.size(), pairs(1, k));
        if (!(std::abs(costs(k)) < kUnmatched)) throw nb::value_error("a cost that is none");
        candidates.push_back({pairs(0, k), pairs(1, k), costs(k)});
    }
    std::vector<int64_t> rows;
    unlocked([&] { rows = assign(candidates, frame.data()); });
    auto [chosen, to] = make<int64_t>({rows.size()});
    std::copy(rows.begin(), rows.end(), to);
    return chosen;
}

auto look_up_pixels(const In<double, -1, -1, 20>& cells, double cell_px, const In<double, -1, 2>& uv) {
    if (cells.shape(0) < 3 || cells.shape(1) < 3) throw nb::value_error("a table without cells");
    const InverseLens lens{cells.data(), int64_t(cells.shape(1)) - 2, int64_t(cells.shape(0)) - 2, cell_px};
    const size_t n = uv.shape(0);
    auto [xy, to_xy] = make({2, n});
    auto [scale, to_scale] = make({2, 2, n});
    unlocked([&, a = to_xy, b = to_scale] { look_up(lens, uv.data(), n, a, b); });
    return std::make_tuple(xy, scale);
}

}  // namespace

void bind_detections(nb::module_& m) {
    nb::class_<Markers>(m, "ExpectedMarkers")
        .def("__init__", &make_expected)
        .def("covariances", &covariances)
        .def("candidates", &candidates);
    m.def("assign", &assign_pairs);
    m.def("look_up", &look_up_pixels);
}

}  // namespace roundel::fusion
