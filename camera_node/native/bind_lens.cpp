// SPDX-License-Identifier: BSD-3-Clause
#include "bind_lens.hpp"

#include <nanobind/ndarray.h>

#include <algorithm>
#include <array>
#include <initializer_list>
#include <utility>

#include "lens/disc_view.hpp"
#include "lens/known_lens.hpp"

namespace nb = nanobind;
using roundel::DiscMeasurement;

template <typename Shape>
using Column = nb::ndarray<const double, Shape, nb::c_contig, nb::device::cpu>;
using Values = Column<nb::shape<-1>>;
using Pairs = Column<nb::shape<-1, 2>>;
using Triples = Column<nb::shape<-1, 3>>;
using Covariances = Column<nb::shape<-1, DiscMeasurement::kCount, DiscMeasurement::kCount>>;

/// The ellipses and offsets of N roundels, as `DetectedRoundels` has them, and their covariances.
struct Measurements {
    Pairs uv, axes;
    Values angle;
    Pairs offset;
    Covariances covariance;

    DiscMeasurement operator[](size_t k) const {
        DiscMeasurement m{
            {uv(k, 0), uv(k, 1), axes(k, 0), axes(k, 1), angle(k)}, {offset(k, 0), offset(k, 1)}, {}};
        for (size_t i = 0; i < m.covariance.size(); ++i)
            for (size_t j = 0; j < m.covariance.size(); ++j) m.covariance[i][j] = covariance(k, i, j);
        return m;
    }
};

static roundel::Lens make_lens(bool is_fisheye, const Values& numbers) {
    constexpr size_t kBasic = 4, kMost = kBasic + roundel::Lens::kDistortion;
    if (numbers.size() < kBasic || numbers.size() > kMost)
        throw nb::value_error("a lens has fx, fy, cx, cy and up to 12 distortion numbers");
    std::array<double, kMost> all{};
    std::copy_n(numbers.data(), numbers.size(), all.data());
    std::array<double, roundel::Lens::kDistortion> distortion;
    std::copy(all.begin() + kBasic, all.end(), distortion.begin());
    return {is_fisheye, all[0], all[1], all[2], all[3], distortion};
}

/// An array of shape (n, ...) that owns its memory, and a pointer to that.
static std::pair<nb::object, double*> make(std::initializer_list<size_t> shape) {
    size_t size = 1;
    for (const size_t n : shape) size *= n;
    auto* data = new double[std::max<size_t>(1, size)];
    const nb::capsule owner(data, [](void* p) noexcept { delete[] static_cast<double*>(p); });
    return {nb::cast(nb::ndarray<nb::numpy, double>(data, shape, owner)), data};
}

/// One row a roundel: u, v, major, minor, angle, the covariance of u, v as uu, uv, vv, and chi-square.
static nb::object constrain(const roundel::Lens& lens, double lens_sigma, const Pairs& uv, const Pairs& axes,
                            const Values& angle, const Pairs& offset, const Covariances& covariance) {
    const size_t n = uv.shape(0);
    if (axes.shape(0) != n || angle.shape(0) != n || offset.shape(0) != n || covariance.shape(0) != n)
        throw nb::value_error("all columns must have one row for each roundel");
    auto [table, rows] = make({n, 9});
    const Measurements measured{uv, axes, angle, offset, covariance};
    for (size_t k = 0; k < n; ++k) {
        const auto [e, cov, chi2] = roundel::constrain_to_lens(measured[k], lens, lens_sigma);
        const std::array row{e.x, e.y, e.major, e.minor, e.angle, cov.xx, cov.xy, cov.yy, chi2};
        rows = std::copy(row.begin(), row.end(), rows);
    }
    return table;
}

/// For each disc of radius 1: its picture, the derivatives of that by the five unknowns, and two directions
/// across the normal.
static nb::object disc_pictures(const Triples& position, const Triples& normal) {
    using roundel::DiscView;
    const size_t n = position.shape(0);
    if (normal.shape(0) != n) throw nb::value_error("positions and normals of different numbers of discs");
    auto [pictures, picture] = make({n, DiscView::kNumbers});
    auto [derivatives, J] = make({n, DiscView::kNumbers, DiscView::kUnknowns});
    auto [tangents, across] = make({n, 3, 2});
    for (size_t k = 0; k < n; ++k) {
        const DiscView disc({position(k, 0), position(k, 1), position(k, 2)},
                            {normal(k, 0), normal(k, 1), normal(k, 2)});
        const auto [seen, by] = disc.predict();
        const auto [first, second] = disc.tangents();
        for (size_t i = 0; i < DiscView::kNumbers; ++i) {
            *picture++ = seen[i];
            for (size_t j = 0; j < DiscView::kUnknowns; ++j) *J++ = by[j][i];
        }
        for (const double value : {first.x, second.x, first.y, second.y, first.z, second.z})
            *across++ = value;
    }
    return nb::make_tuple(pictures, derivatives, tangents);
}

void bind_lens(nb::module_& m) {
    m.def("disc_pictures", &disc_pictures, nb::arg("position"), nb::arg("normal"));
    nb::class_<roundel::Lens>(m, "Lens")
        .def(
            "__init__",
            [](roundel::Lens* lens, bool is_fisheye, const Values& numbers) {
                new (lens) roundel::Lens(make_lens(is_fisheye, numbers));
            },
            nb::arg("is_fisheye"), nb::arg("numbers"))
        .def("constrain", &constrain, nb::arg("lens_sigma"), nb::arg("uv"), nb::arg("axes_px"),
             nb::arg("angle_rad"), nb::arg("offset_px"), nb::arg("pose_cov"));
}
