// SPDX-License-Identifier: BSD-3-Clause
#include <nanobind/stl/tuple.h>

#include <algorithm>

#include "arrays.hpp"
#include "assignment.hpp"
#include "candidates.hpp"
#include "inverse_lens.hpp"
#include "labelings.hpp"
#include "numeric/unaligned.hpp"

namespace roundel::fusion {
namespace {

/// The arrays of N detections, sorted by frame.
struct DetectionColumns {
    Index frame;
    Pairs xy;
    Matrices2 scale, cov;
    Numbers major, code, delay;

    DetectionColumns(const Index& frames, const Pairs& xys, const Matrices2& scales, const Matrices2& covs,
                     const Numbers& majors, const Numbers& codes, const Numbers& delays)
        : frame(frames), xy(xys), scale(scales), cov(covs), major(majors), code(codes), delay(delays) {
        require_equal(frame.size(),
                      {xy.shape(1), scale.shape(2), cov.shape(2), major.size(), code.size(), delay.size()});
    }

    Detections view() const {
        const size_t n = frame.size();
        return {frame.data(), columns<2>(xy, n), columns<4>(scale, n), columns<4>(cov, n),
                major.data(), code.data(),       delay.data()};
    }
};

/// R and P are by body; `body`, `code`, `position`, `normal` and `radius` are by marker.
void make_expected(ExpectedMarkers* self, const Rotations& R, const Covariances& P, const Index& body,
                   const Index& code, const Vectors& position, const Vectors& normal, const Numbers& radius) {
    const size_t n = body.size();
    require_equal(R.shape(0), {P.shape(0)});
    require_equal(n, {code.size(), radius.size()});
    below(R.shape(0), body);
    const auto positions = columns<3>(position, n), normals = columns<3>(normal, n);
    std::vector<ExpectedMarker> markers;
    markers.reserve(n);
    for (size_t k = 0; k < n; ++k)
        markers.push_back(ExpectedMarker::of(body(k), code(k),
                                             {positions.vector(k), normals.vector(k), radius(k)},
                                             matrix_at(R.data() + 9 * body(k)), P.data() + 144 * body(k)));
    new (self) ExpectedMarkers(std::move(markers));
}

Out covariances(const ExpectedMarkers& markers, double tau) {
    auto [all, to] = make({markers.all().size(), 3, 3});
    for (const ExpectedMarker& marker : markers.all()) {
        write(marker.covariance(tau), to);
        to += 9;
    }
    return all;
}

/// Markers in the world: (3, K, 3) positions, velocities and normals, and covariances of the positions.
auto marker_states(const BodyStates& bodies, const Covariances& P, const Index& body, const Vectors& position,
                   const Vectors& normal) {
    const size_t n = body.size();
    require_equal(bodies.size(), {P.shape(0)});
    below(bodies.size(), body);
    const auto positions = columns<3>(position, n), normals = columns<3>(normal, n);
    auto [vectors, to] = make({3, n, 3});
    auto [covariances, to_covariance] = make({n, 3, 3});
    for (size_t k = 0; k < n; ++k) {
        const Body& of = bodies[body(k)];
        const Vector arm = of.R * positions.vector(k);
        write(of.p + arm, to + 3 * k);
        write(of.v + cross(of.omega, arm), to + 3 * (n + k));
        write(of.R * normals.vector(k), to + 3 * (2 * n + k));
        write(position_covariance(positions.vector(k), of.R, P.data() + 144 * body(k)),
              to_covariance + 9 * k);
    }
    return std::make_tuple(vectors, covariances);
}

auto candidates(const ExpectedMarkers& markers, const FramePoses& poses, const DetectionColumns& detections,
                const Numbers& focal) {
    below(poses.exposures().size(), detections.frame);
    require_equal(poses.exposures().size(), {focal.size()});
    for (const auto& marker : markers.all()) require_below(poses.n_bodies(), marker.body);
    std::vector<Candidate> found;
    unlocked([&, all = detections.view()] { found = find_candidates(poses, markers, all, focal.data()); });
    auto [pairs, rows] = make<int64_t>({2, found.size()});
    auto [costs, to] = make({found.size()});
    for (const Candidate& pair : found) {
        rows[found.size()] = pair.detection;
        *rows++ = pair.marker;
        *to++ = pair.cost;
    }
    return std::make_tuple(pairs, costs);
}

auto assigned(const In<int64_t, 2, -1>& pairs, const Numbers& cost, const Index& frame) {
    const size_t n = cost.size();
    require_equal(n, {pairs.shape(1)});
    const int64_t *marker = pairs.data(), *detection = pairs.data() + n;
    for (size_t k = 0; k < n; ++k) require_below(frame.size(), detection[k]);
    std::vector<int64_t> chosen;
    unlocked([&] { chosen = assign({marker, detection, cost.data(), n}, frame.data(), frame.size()); });
    auto [numbers, to] = make<int64_t>({chosen.size()});
    std::copy(chosen.begin(), chosen.end(), to);
    return numbers;
}

/// The pairs of view v are those from first[v] to first[v + 1].
auto labelings(const Index& first, const Index& marker, const Index& detection, const Numbers& cost,
               const Index& least, const Numbers& most, size_t max_steps, size_t max_labelings) {
    const size_t views = least.size(), n = cost.size();
    require_equal(views + 1, {first.size(), most.size() + 1});
    require_equal(n, {marker.size(), detection.size()});
    const int64_t* const starts = first.data();
    if (starts[0] != 0 || starts[views] != int64_t(n) || !std::is_sorted(starts, starts + views + 1))
        throw nb::index_error("views do not divide the pairs");
    std::vector<std::vector<Labeling>> found(views);
    unlocked([&] {
        for (size_t v = 0; v < views; ++v) {
            const size_t k = size_t(first(v));
            const MarkerPairs pairs{marker.data() + k, detection.data() + k, cost.data() + k,
                                    size_t(first(v + 1)) - k};
            found[v] = find_labelings(pairs, least(v), most(v), {max_steps, max_labelings});
        }
    });
    size_t total = 0, rows = 0;
    for (const auto& of_view : found)
        for (const Labeling& one : of_view) ++total, rows += one.pairs.size();
    auto [view, to_view] = make<int64_t>({total});
    auto [costs, to_cost] = make({total});
    auto [labeling, to_labeling] = make<int64_t>({rows});
    auto [pair, to_pair] = make<int64_t>({rows});
    int64_t number = 0;
    for (size_t v = 0; v < views; ++v)
        for (const Labeling& one : found[v]) {
            *to_view++ = int64_t(v);
            *to_cost++ = one.cost;
            to_labeling = std::fill_n(to_labeling, one.pairs.size(), number++);
            for (const int64_t k : one.pairs) *to_pair++ = first(v) + k;
        }
    return std::make_tuple(view, costs, labeling, pair);
}

constexpr double kMinAxis = 0.5, kMaxAxis = 1e5;  // of a plausible outline, pixels
constexpr double kRounding = 1.001;               // of the axes of a circle, as floats of another program

/// Writes NaN in place of the full axes (2 x N) and the directions (N) of impossible outlines.
void forget_impossible(double* outlines, size_t n) {
    for (size_t k = 0; k < n; ++k) {
        const double major = outlines[k], minor = outlines[n + k];
        if (minor > kMinAxis && minor <= kRounding * major && major < kMaxAxis &&
            std::isfinite(outlines[2 * n + k]))
            continue;
        for (size_t row = 0; row < 3; ++row) outlines[row * n + k] = std::numeric_limits<double>::quiet_NaN();
    }
}

/// Writes these numbers of all rows of a column of a message, one after another.
template <class From>
double* append(double* to, const nb::bytes& column, size_t n, size_t width,
               std::initializer_list<size_t> order) {
    if (column.size() != n * width * sizeof(From)) throw nb::value_error("columns of different lengths");
    for (const size_t i : order)
        for (size_t k = 0; k < n; ++k) *to++ = double(number_at<From>(column.c_str(), k * width + i));
    return to;
}

/// The columns of a detection table (19, N) of the columns of a message, before `undistort`. A number without
/// a probability comes from a file and is no code.
Out detection_columns(const nb::bytes& uv, const nb::bytes& cov, const nb::bytes& axes,
                      const nb::bytes& angle, const nb::bytes& id, const nb::bytes& probability,
                      const nb::bytes& rotation, const nb::bytes& sigma) {
    const size_t n = uv.size() / (2 * sizeof(double));
    auto [all, to] = make({19, n});
    const auto append_known = [n](double* at, const nb::bytes& column) {
        return column.size() ? append<float>(at, column, n, 1, {0})
                             : std::fill_n(at, n, std::numeric_limits<double>::quiet_NaN());
    };
    to = append<double>(to, uv, n, 2, {0, 1});
    to = append<float>(to, cov, n, 3, {0, 1, 1, 2});
    to = append<float>(to, axes, n, 2, {0, 1});
    to = append<float>(to, angle, n, 1, {0});
    append_known(to, probability);
    double* const code = to + 6 * n;
    append<int32_t>(code, id, n, 1, {0});
    for (size_t k = 0; k < n; ++k)
        if (!std::isfinite(to[k])) code[k] = -1;
    to = append_known(append_known(code + n, rotation), sigma);
    std::fill_n(to, n, 0.0);
    return all;
}

/// Writes the undistorted coordinates and the scale of the columns of a detection table (19, N), NaN in place
/// of impossible outlines, and adds a variance to the centres. Returns whether the cells have all roundels.
bool undistort(const In<double, -1, -1, 20>& cells, double cell_px, double added_px2,
               nb::ndarray<double, nb::shape<19, -1>, nb::c_contig, nb::device::cpu> table) {
    if (cells.shape(0) < 3 || cells.shape(1) < 3) throw nb::value_error("a table without cells");
    const InverseLens lens{cells.data(), int64_t(cells.shape(1)) - 2, int64_t(cells.shape(0)) - 2, cell_px};
    const size_t n = table.shape(1);
    double *const uv = table.data(), *const cov = uv + 2 * n, *const axes = cov + 4 * n, *xy = axes + 3 * n;
    for (double* const variance : {cov, cov + 3 * n})
        for (size_t k = 0; k < n; ++k) variance[k] += added_px2;
    forget_impossible(axes, n);
    look_up(lens, {{uv, n}, {axes, n}, axes + 2 * n}, xy, xy + 2 * n);
    return std::none_of(xy, xy + n, [](double x) { return std::isnan(x); });
}

}  // namespace

void bind_detections(nb::module_& m) {
    m.attr("SLACK_PX") = kSlackPx;
    nb::class_<DetectionColumns>(m, "DetectionColumns")
        .def(nb::init<const Index&, const Pairs&, const Matrices2&, const Matrices2&, const Numbers&,
                      const Numbers&, const Numbers&>());
    nb::class_<ExpectedMarkers>(m, "ExpectedMarkers")
        .def("__init__", &make_expected)
        .def("covariances", &covariances)
        .def("candidates", &candidates);
    m.def("marker_states", &marker_states);
    m.def("assign", &assigned);
    m.def("labelings", &labelings);
    m.def("detection_columns", &detection_columns);
    m.def("undistort", &undistort, nb::arg("cells"), nb::arg("cell_px"), nb::arg("added_px2"),
          nb::arg("columns").noconvert());
}

}  // namespace roundel::fusion
