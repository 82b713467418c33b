// SPDX-License-Identifier: BSD-3-Clause
#include <nanobind/stl/tuple.h>

#include <algorithm>

#include "arrays.hpp"
#include "body_fit.hpp"
#include "rig_response.hpp"

namespace roundel::fusion {
namespace {

/// The arrays of N discs. Their indices are checked where the numbers of frames and bodies are known.
struct DiscColumns {
    Index frame, body;
    Vectors position, normal;
    Numbers radius, delay;

    DiscColumns(const Index& frames, const Index& bodies, const Vectors& positions, const Vectors& normals,
                const Numbers& radii, const Numbers& delays)
        : frame(frames), body(bodies), position(positions), normal(normals), radius(radii), delay(delays) {
        require_equal(frame.size(),
                      {body.size(), position.shape(1), normal.shape(1), radius.size(), delay.size()});
    }
};

void make_bodies(BodyStates* self, const Rotations& R, const Positions& p, const Positions& omega,
                 const Positions& v) {
    require_equal(R.shape(0), {p.shape(0), omega.shape(0), v.shape(0)});
    BodyStates bodies;
    bodies.reserve(R.shape(0));
    for (size_t b = 0; b < R.shape(0); ++b)
        bodies.push_back({matrix_at(R.data() + 9 * b), vector_at(p.data() + 3 * b),
                          vector_at(omega.data() + 3 * b), vector_at(v.data() + 3 * b)});
    new (self) BodyStates(std::move(bodies));
}

void make_exposures(CameraExposures* self, const Rotations& R_cam_world, const Positions& centres,
                    const Numbers& tau, const Numbers& tau_sigma) {
    require_equal(tau.size(), {R_cam_world.shape(0), centres.shape(0), tau_sigma.size()});
    CameraExposures exposures;
    exposures.reserve(tau.size());
    for (size_t f = 0; f < tau.size(); ++f)
        exposures.push_back(
            {matrix_at(R_cam_world.data() + 9 * f), vector_at(centres.data() + 3 * f), tau(f), tau_sigma(f)});
    new (self) CameraExposures(std::move(exposures));
}

Discs discs_of(size_t n_frames, size_t n_bodies, const DiscColumns& discs) {
    const size_t n = discs.frame.size();
    return {below(n_frames, discs.frame), below(n_bodies, discs.body), columns<3>(discs.position, n),
            columns<3>(discs.normal, n),  discs.radius.data(),         discs.delay.data()};
}
Discs discs_of(const FramePoses& poses, const DiscColumns& discs) {
    return discs_of(poses.exposures().size(), poses.n_bodies(), discs);
}

Out views_of(const FramePoses& poses, const DiscColumns& columns_of) {
    const Discs discs = discs_of(poses, columns_of);
    auto [views, to] = make({11, discs.size()});
    unlocked([&, to = to] { view_discs(poses, discs, to); });
    return views;
}

template <class Observations>
Out linearized(const FramePoses& poses, const Observations& observed, size_t n) {
    auto [equations, to] = make({n, 2, kErrors + 1});
    unlocked([&, to = reinterpret_cast<Equations*>(to)] {
        for (size_t k = 0; k < n; ++k) to[k] = linearize(poses, observed, k);
    });
    return equations;
}

Out linearize_centres(const FramePoses& poses, const DiscColumns& columns_of, const Pairs& xy,
                      const Matrices2& whiten, const In<bool, -1>& single) {
    const Discs discs = discs_of(poses, columns_of);
    require_equal(poses.n_bodies(), {single.size()});
    const CentreObservations observed{discs, columns<2>(xy, discs.size()), columns<4>(whiten, discs.size()),
                                      single.data()};
    return linearized(poses, observed, discs.size());
}

Out differentiate_by_camera(const FramePoses& poses, const DiscColumns& columns_of, const Matrices2& whiten,
                            const Pairs& by_focal) {
    const Discs discs = discs_of(poses, columns_of);
    const auto scales = columns<4>(whiten, discs.size());
    const auto focal = columns<2>(by_focal, discs.size());
    auto [derivatives, to] = make({discs.size(), 2, kCameraErrors});
    unlocked([&, to = to] {
        differentiate(poses, discs, scales, focal, reinterpret_cast<CameraDerivatives*>(to));
    });
    return derivatives;
}

Out linearize_outlines(const FramePoses& poses, const DiscColumns& columns_of, const Pairs& axes,
                       const Numbers& angle, const Matrices2& scale, const Numbers& sigma) {
    const Discs discs = discs_of(poses, columns_of);
    require_equal(discs.size(), {angle.size(), sigma.size()});
    const OutlineObservations observed{discs, columns<2>(axes, discs.size()), angle.data(),
                                       columns<4>(scale, discs.size()), sigma.data()};
    return linearized(poses, observed, discs.size());
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
            outline(c.vector(k), d.vector(k), radius(k), scale_at(columns<4>(scale, n), k));
        const Shear s = shear(measured, expected);
        to[k] = s.along;
        to[n + k] = s.across;
    }
    return both;
}

/// (N,) squared lengths in pixels of N whitened errors, whose covariances are `cov`; NaN where `whiten` is.
std::pair<Out, double*> squared_lengths(const double* errors, Columns<4> cov, Columns<4> whiten) {
    auto [squares, to] = make({cov.n});
    for (size_t k = 0; k < cov.n; ++k) {  // errors = L^-1 pixels, where L L^T is the covariance
        const CovarianceFactor L(cov, k);
        const double u = L.a * errors[2 * k], v = L.b * errors[2 * k] + L.c * errors[2 * k + 1];
        to[k] = std::isfinite(whiten.at(0, k)) ? u * u + v * v : std::numeric_limits<double>::quiet_NaN();
    }
    return {squares, to};
}

/// `BodyFit` with the arrays that it reads.
class ArrayFit {
  public:
    ArrayFit(const BodyStates& bodies, const CameraExposures& exposures, const DiscColumns& discs,
             const Pairs& xy, const Matrices2& whiten, const Mask& single, const Pairs& axes,
             const Numbers& angle, const Matrices2& scale, const Numbers& sigma, const Mask& shaped,
             const Mask& turned, const EquationArray& predicted, const Covariances& information)
        : discs_(discs),
          columns_(xy, whiten, single, axes, angle, scale, sigma, shaped, turned, predicted, information),
          fit_(bodies, exposures, observed(bodies.size(), exposures.size()),
               reinterpret_cast<const ErrorMatrix*>(information.data())) {}

    auto linearize(const EquationArray& headings) {
        require_equal(fit_.n_turned(), {headings.shape(0)});
        unlocked([&] { fit_.linearize(reinterpret_cast<const Equations*>(headings.data())); });
        return std::make_tuple(copied(fit_.information(), {fit_.moving().size(), kErrors, kErrors}),
                               copied(fit_.right(), {fit_.moving().size(), kErrors}));
    }
    bool step(const In<double, -1, 12>& steps, double small) {
        require_equal(fit_.moving().size(), {steps.shape(0), fit_.right().size()});
        return fit_.step(reinterpret_cast<const ErrorVector*>(steps.data()), small);
    }
    auto estimates() const {
        const auto& bodies = fit_.estimates();
        auto [R, to_R] = make({bodies.size(), 3, 3});
        auto [vectors, to] = make({3, bodies.size(), 3});
        for (size_t b = 0; b < bodies.size(); ++b) {
            write(bodies[b].R, to_R + 9 * b);
            write(bodies[b].p, to + 3 * b);
            write(bodies[b].omega, to + 3 * (bodies.size() + b));
            write(bodies[b].v, to + 3 * (2 * bodies.size() + b));
        }
        return std::make_tuple(R, vectors);
    }
    /// The estimates, then their covariances, of the centres the equations, weights and squared residuals,
    /// and the costs of the bodies. `P` has the covariances of bodies without observations.
    auto result(const Covariances& P, const Matrices2& cov) const {
        const size_t n = discs_.frame.size(), n_bodies = fit_.estimates().size();
        require_equal(n_bodies, {P.shape(0)});
        const auto [R, vectors] = estimates();
        auto [fitted, to_fitted] = make({n_bodies, kErrors, kErrors});
        auto [weights, to_weight] = make({n});
        auto [costs, to_cost] = make({n_bodies});
        std::copy_n(P.data(), P.size(), to_fitted);
        fit_.write_covariances(reinterpret_cast<ErrorMatrix*>(to_fitted));
        std::copy_n(fit_.weights().data(), n, to_weight);
        const auto [squares, square] = squared_lengths(fit_.residuals()[0].data(), columns<4>(cov, n),
                                                       columns<4>(std::get<1>(columns_), n));
        std::vector<double> squared(n);
        for (size_t k = 0; k < n; ++k) squared[k] = square[k] / ((cov(0, 0, k) + cov(1, 1, k)) / 2);
        fit_.write_costs(squared.data(), to_cost);
        return std::make_tuple(R, vectors, fitted, copied(fit_.equations(), {n, 2, kErrors + 1}), weights,
                               squares, costs);
    }

  private:
    /// The numbers of the first rows of a vector of arrays.
    template <class Row>
    static Out copied(const std::vector<Row>& rows, std::initializer_list<size_t> shape) {
        auto [array, to] = make(shape);
        std::copy_n(rows.data(), *shape.begin(), reinterpret_cast<Row*>(to));
        return array;
    }
    FitObservations observed(size_t n_bodies, size_t n_frames) const {
        const auto& [xy, whiten, single, axes, angle, scale, sigma, shaped, turned, predicted, information] =
            columns_;
        const Discs discs = discs_of(n_frames, n_bodies, discs_);
        const size_t n = discs.size();
        require_equal(n_bodies, {single.size(), information.shape(0)});
        require_equal(n, {angle.size(), sigma.size(), shaped.size(), turned.size(), predicted.shape(0)});
        return {{discs, columns<2>(xy, n), columns<4>(whiten, n), single.data()},
                reinterpret_cast<const Equations*>(predicted.data()),
                {discs, columns<2>(axes, n), angle.data(), columns<4>(scale, n), sigma.data()},
                shaped.data(),
                turned.data()};
    }

    DiscColumns discs_;
    std::tuple<Pairs, Matrices2, Mask, Pairs, Numbers, Matrices2, Numbers, Mask, Mask, EquationArray,
               Covariances>
        columns_;
    BodyFit fit_;
};

/// (2, 2, N) L^-1 scale of N detections, where L L^T is the covariance.
Out whiten(const Matrices2& cov, const Matrices2& scale) {
    const size_t n = cov.shape(2);
    const auto P = columns<4>(cov, n), scales = columns<4>(scale, n);
    auto [whitened, to] = make({2, 2, n});
    for (size_t k = 0; k < n; ++k) {
        const CovarianceFactor L(P, k);
        for (int j = 0; j < 2; ++j) {
            const double first = scales.at(j, k) / L.a;
            to[j * n + k] = first;
            to[(2 + j) * n + k] = (scales.at(2 + j, k) - L.b * first) / L.c;
        }
    }
    return whitened;
}

Out squared_px(const In<double, -1, 2>& errors, const Matrices2& cov, const Matrices2& whiten) {
    const size_t n = errors.shape(0);
    return squared_lengths(errors.data(), columns<4>(cov, n), columns<4>(whiten, n)).first;
}

template <nb::ssize_t... shape>
using InOut = nb::ndarray<double, nb::shape<shape...>, nb::c_contig, nb::device::cpu>;

void respond_arrays(const FramePoses& poses, const Index& camera, const EquationArray& equations,
                    const Numbers& weights, const Numbers& rig_share, const Index& frame, const Index& body,
                    const Pairs& xy, const Matrices2& whiten, const Covariances& information,
                    const Covariances& P, const Rotations& T, const Numbers& dt,
                    const InOut<-1, -1, 12, 8>& responses, const InOut<-1, 12, 12>& counted) {
    const size_t n = body.size(), n_bodies = poses.n_bodies(), n_cameras = responses.shape(1);
    require_equal(n, {equations.shape(0), weights.size(), rig_share.size(), frame.size()});
    require_equal(n_bodies, {information.shape(0), P.shape(0), T.shape(0), dt.size(), responses.shape(0),
                             counted.shape(0)});
    require_equal(poses.exposures().size(), {camera.size()});
    below(poses.exposures().size(), frame);
    below(n_cameras, camera);
    const WeightedEquations observed{
        {reinterpret_cast<const Equations*>(equations.data()), below(n_bodies, body), n, n_bodies},
        weights.data(),
        rig_share.data(),
        frame.data(),
        columns<2>(xy, n),
        columns<4>(whiten, n)};
    const FilterSteps steps{reinterpret_cast<const ErrorMatrix*>(information.data()),
                            reinterpret_cast<const ErrorMatrix*>(P.data()), T.data(), dt.data()};
    unlocked([&] {
        respond(poses, observed, steps, camera.data(), n_cameras,
                reinterpret_cast<CameraBlock*>(responses.data()),
                reinterpret_cast<ErrorMatrix*>(counted.data()));
    });
}

Out consider_arrays(const Covariances& P, const Covariances& counted,
                    const In<double, -1, -1, 12, 8>& responses, const In<double, -1, -1>& factor,
                    const Rotations& R, const In<double, -1, 6, 6>& frame) {
    const size_t n = P.shape(0), d = factor.shape(0);
    require_equal(n, {counted.shape(0), responses.shape(0), R.shape(0), frame.shape(0)});
    require_equal(d, {factor.shape(1), kCameraErrors * responses.shape(1)});
    auto [claimed, to] = make({n, kErrors, kErrors});
    const Considered bodies{reinterpret_cast<const ErrorMatrix*>(counted.data()),
                            reinterpret_cast<const CameraBlock*>(responses.data()), R.data(), frame.data()};
    unlocked([&, to = to] {
        consider(reinterpret_cast<const ErrorMatrix*>(P.data()), bodies, factor.data(), n, responses.shape(1),
                 reinterpret_cast<ErrorMatrix*>(to));
    });
    return claimed;
}

}  // namespace

void bind_poses(nb::module_& m) {
    nb::class_<BodyStates>(m, "BodyStates").def("__init__", &make_bodies);
    nb::class_<CameraExposures>(m, "CameraExposures").def("__init__", &make_exposures);
    nb::class_<DiscColumns>(m, "DiscColumns")
        .def(nb::init<const Index&, const Index&, const Vectors&, const Vectors&, const Numbers&,
                      const Numbers&>());
    nb::class_<FramePoses>(m, "FramePoses")
        .def(nb::init<const BodyStates&, const CameraExposures&>())
        .def("views", &views_of)
        .def("linearize_centres", &linearize_centres)
        .def("differentiate_by_camera", &differentiate_by_camera)
        .def("linearize_outlines", &linearize_outlines);
    nb::class_<ArrayFit>(m, "BodyFit")
        .def(nb::init<const BodyStates&, const CameraExposures&, const DiscColumns&, const Pairs&,
                      const Matrices2&, const Mask&, const Pairs&, const Numbers&, const Matrices2&,
                      const Numbers&, const Mask&, const Mask&, const EquationArray&, const Covariances&>())
        .def("linearize", &ArrayFit::linearize)
        .def("step", &ArrayFit::step)
        .def("estimates", &ArrayFit::estimates)
        .def("result", &ArrayFit::result);
    m.def("whiten", &whiten);
    m.def("squared_px", &squared_px);
    m.def("shears", &shears_of);
    m.def("respond", &respond_arrays, nb::arg("poses"), nb::arg("camera"), nb::arg("equations"),
          nb::arg("weights"), nb::arg("rig_share"), nb::arg("frame"), nb::arg("body"), nb::arg("xy"),
          nb::arg("whiten"), nb::arg("information"), nb::arg("P"), nb::arg("T"), nb::arg("dt"),
          nb::arg("responses").noconvert(), nb::arg("counted").noconvert());
    m.def("consider", &consider_arrays);
}

}  // namespace roundel::fusion
