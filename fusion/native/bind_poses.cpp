// SPDX-License-Identifier: BSD-3-Clause
#include "arrays.hpp"
#include "linearisation.hpp"

namespace roundel::fusion {
namespace {

void make_poses(Poses* self, const In<double, -1, 3, 3>& R, const In<double, -1, 3>& p,
                const In<double, -1, 3>& omega, const In<double, -1, 3>& v,
                const In<double, -1, 3, 3>& R_cam_world, const In<double, -1, 3>& centres,
                const Numbers& tau) {
    require_equal(R.shape(0), {p.shape(0), omega.shape(0), v.shape(0)});
    require_equal(tau.size(), {R_cam_world.shape(0), centres.shape(0)});
    std::vector<Body> bodies;
    for (size_t b = 0; b < R.shape(0); ++b)
        bodies.push_back({matrix_at(R.data() + 9 * b), vector_at(p.data() + 3 * b),
                          vector_at(omega.data() + 3 * b), vector_at(v.data() + 3 * b)});
    std::vector<Exposure> exposures;
    for (size_t f = 0; f < tau.size(); ++f)
        exposures.push_back(
            {matrix_at(R_cam_world.data() + 9 * f), vector_at(centres.data() + 3 * f), tau(f)});
    new (self) Poses(std::move(bodies), std::move(exposures));
}

Discs discs_of(const Poses& poses, const Index& frame, const Index& body, const Vectors& marker,
               const Numbers& radius) {
    require_equal(frame.size(), {body.size(), radius.size()});
    return {below(poses.exposures().size(), frame), below(poses.n_bodies(), body),
            columns<3>(marker, frame.size()), radius.data()};
}

Out view_discs(const Poses& poses, const Index& frame, const Index& body, const Vectors& marker,
               const Numbers& radius) {
    const Discs discs = discs_of(poses, frame, body, marker, radius);
    auto [views, to] = make({11, discs.size()});
    unlocked([&] { view_all(poses, discs, to); });
    return views;
}

Out linearise_centres(const Poses& poses, const Index& frame, const Index& body, const Vectors& marker,
                      const Numbers& radius, const Pairs& xy, const Matrices2& whiten,
                      const In<bool, -1>& single) {
    const Discs discs = discs_of(poses, frame, body, marker, radius);
    require_equal(poses.n_bodies(), {single.size()});
    const Centres seen{discs, columns<2>(xy, discs.size()), columns<4>(whiten, discs.size()), single.data()};
    auto [rows, to] = make({discs.size(), 2, kErrors + 1});
    unlocked([&] { linearise(poses, seen, reinterpret_cast<Rows*>(to)); });
    return rows;
}

Out linearise_outlines(const Poses& poses, const Index& frame, const Index& body, const Vectors& marker,
                       const Numbers& radius, const Pairs& axes, const Numbers& angle, const Matrices2& scale,
                       const Numbers& sigma) {
    const Discs discs = discs_of(poses, frame, body, marker, radius);
    require_equal(discs.size(), {angle.size(), sigma.size()});
    const Outlines seen{discs, columns<2>(axes, discs.size()), angle.data(), columns<4>(scale, discs.size()),
                        sigma.data()};
    auto [rows, to] = make({discs.size(), 2, kErrors + 1});
    unlocked([&] { linearise(poses, seen, reinterpret_cast<Rows*>(to)); });
    return rows;
}

Out shears_of(const Pairs& axes, const Numbers& angle, const Vectors& centre, const Vectors& normal,
              const Numbers& radius, const Matrices2& scale) {
    const size_t n = angle.size();
    require_equal(n, {axes.shape(1), centre.shape(1), normal.shape(1), radius.size(), scale.shape(2)});
    auto [both, to] = make({2, n});
    const Columns<3> c{centre.data(), n}, d{normal.data(), n};
    for (size_t k = 0; k < n; ++k) {
        const Shape measured = measured_outline(axes(0, k), axes(1, k), angle(k));
        const Shape expected =
            outline(c.vector(k), d.vector(k), radius(k), Scale::of(columns<4>(scale, n), k));
        const Shear s = shear(measured, expected);
        to[k] = s.along, to[n + k] = s.across;
    }
    return both;
}

}  // namespace

void bind_poses(nb::module_& m) {
    nb::class_<Poses>(m, "Poses")
        .def("__init__", &make_poses)
        .def("view", &view_discs)
        .def("linearise", &linearise_centres)
        .def("linearise_outlines", &linearise_outlines);
    m.def("shears", &shears_of);
}

}  // namespace roundel::fusion
