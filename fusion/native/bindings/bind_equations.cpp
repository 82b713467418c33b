// SPDX-License-Identifier: BSD-3-Clause
#include <nanobind/stl/tuple.h>

#include <algorithm>

#include "arrays.hpp"
#include "elimination.hpp"
#include "motion_models.hpp"

namespace roundel::fusion {
namespace {

Out inverses(const Covariances& information) {
    auto [covariances, to] = make({information.shape(0), kErrors, kErrors});
    const auto* from = reinterpret_cast<const ErrorMatrix*>(information.data());
    unlocked([&, out = reinterpret_cast<ErrorMatrix*>(to)] {
        std::transform(from, from + information.shape(0), out, inverse);
    });
    return covariances;
}

auto are_own(const EquationArray& equations, const Matrices2& cov, const Numbers& log_density,
             const Index& body, const Index& camera, const Mask& certain, const Covariances& information,
             const Index& of_body, const Index& of_camera, const Index& turn, const Numbers& prior,
             const Numbers& added_px2) {
    const size_t n = body.size(), n_asked = of_body.size();
    require_equal(n, {equations.shape(0), log_density.size(), camera.size(), certain.size()});
    require_equal(n_asked, {of_camera.size(), turn.size(), prior.size(), added_px2.size()});
    const size_t n_bodies = information.shape(0);
    const Evidence evidence{
        {reinterpret_cast<const Equations*>(equations.data()), below(n_bodies, body), n, n_bodies},
        columns<4>(cov, n),
        log_density.data(),
        camera.data()};
    const Doubts doubts{below(n_bodies, of_body), of_camera.data(), turn.data(), prior.data(),
                        added_px2.data(),         n_asked};
    auto [own, to] = make<bool>({n});
    std::copy_n(certain.data(), n, to);
    accept(evidence, doubts, reinterpret_cast<const ErrorMatrix*>(information.data()), to);
    return own;
}

auto eliminate_robots(const In<double, -1, 2, 24>& equations, const Numbers& weights, const Index& body,
                      const Index& camera, const Index& marker, const Index& robot, const Index& owner,
                      const In<double, -1, 12>& information, const In<double, -1, 12>& right,
                      const In<double, -1, 3>& of_places, const In<double, -1, 3>& right_of_places,
                      size_t n_cameras, double damping) {
    const size_t n = weights.size(), n_bodies = information.shape(0), n_markers = owner.size();
    require_equal(n, {equations.shape(0), body.size(), camera.size(), marker.size()});
    require_equal(n_bodies, {right.shape(0), robot.size()});
    require_equal(n_markers, {of_places.shape(0), right_of_places.shape(0)});
    const auto n_robots = n_markers ? size_t(owner(n_markers - 1)) + 1 : 0;
    const JointSystem system{reinterpret_cast<const JointEquations*>(equations.data()),
                             weights.data(),
                             below(n_bodies, body),
                             below(n_cameras, camera),
                             below(n_markers, marker),
                             below(n_robots, robot),
                             owner.data(),
                             n,
                             n_bodies,
                             n_cameras,
                             n_markers};
    using Place = std::array<double, kPlaceErrors>;
    const RobotPriors priors{reinterpret_cast<const ErrorVector*>(information.data()),
                             reinterpret_cast<const ErrorVector*>(right.data()),
                             reinterpret_cast<const Place*>(of_places.data()),
                             reinterpret_cast<const Place*>(right_of_places.data()), damping};
    const size_t d = kCameraErrors * n_cameras;
    auto [reduced, to_reduced] = make({d, d + 1});
    auto [by_body, to_body] = make({n_bodies, kErrors, d + 1});
    auto [by_marker, to_marker] = make({n_markers, kPlaceErrors, d + 1});
    auto [places, to_places] = make({kPlaceErrors * n_markers, kPlaceErrors * n_markers});
    std::fill_n(to_marker, by_marker.size(), 0.0);
    std::fill_n(to_places, places.size(), 0.0);
    const Eliminated to{to_reduced, to_body, to_marker, to_places};
    unlocked([&] { eliminate(system, priors, to); });
    return std::make_tuple(reduced, by_body, by_marker, places);
}

auto predict_bodies(const BodyStates& bodies, const Covariances& P, const Numbers& dt,
                    const In<double, -1, 2>& densities, const In<bool, -1>& single) {
    const size_t n = bodies.size();
    require_equal(n, {P.shape(0), dt.size(), densities.shape(0), single.size()});
    auto [R_then, to_R] = make({n, 3, 3});
    auto [p_then, to_p] = make({n, 3});
    auto [P_then, to_P] = make({n, kErrors, kErrors});
    auto [T, to_T] = make({n, 3, 3});
    std::copy_n(P.data(), P.size(), to_P);
    for (size_t b = 0; b < n; ++b) {
        Body body = bodies[b];
        const MotionInterval interval{dt(b), densities(b, 0), densities(b, 1), single(b)};
        write(predict(body, reinterpret_cast<ErrorMatrix*>(to_P)[b], interval), to_T + 9 * b);
        write(body.R, to_R + 9 * b);
        write(body.p, to_p + 3 * b);
    }
    return std::make_tuple(R_then, p_then, P_then, T);
}

auto weigh_motions_of(const BodyStates& bodies, const Covariances& P, const Covariances& information,
                      const Numbers& dt, const In<double, -1, 2>& densities, const Mask& single,
                      const EquationArray& equations, const Index& body, const Index& camera,
                      const Numbers& rig_share, const In<double, -1, kModels>& before,
                      const In<double, kModels>& shares) {
    const size_t n = bodies.size();
    require_equal(
        n, {P.shape(0), information.shape(0), dt.size(), densities.shape(0), single.size(), before.shape(0)});
    require_equal(body.size(), {equations.shape(0), camera.size(), rig_share.size()});
    std::vector<MotionInterval> intervals;
    for (size_t b = 0; b < n; ++b) intervals.push_back({dt(b), densities(b, 0), densities(b, 1), single(b)});
    auto [probabilities, to_probabilities] = make({n, kModels});
    auto [P_seen, to_P] = make({n, kErrors, kErrors});
    auto [information_seen, to_information] = make({n, kErrors, kErrors});
    std::copy_n(before.data(), before.size(), to_probabilities);
    std::copy_n(P.data(), P.size(), to_P);
    std::copy_n(information.data(), information.size(), to_information);
    const PredictedBodies predicted{
        bodies.data(),
        reinterpret_cast<const ErrorMatrix*>(P.data()),
        intervals.data(),
        {reinterpret_cast<const Equations*>(equations.data()), below(n, body), body.size(), n},
        camera.data(),
        rig_share.data()};
    ModelNumbers of_declared;
    std::copy_n(shares.data(), kModels, of_declared.begin());
    std::vector<size_t> weighed;
    unlocked([&, of_bodies = to_probabilities, out = to_P, inverted = to_information] {
        weighed = weigh_motions(predicted, of_declared, of_bodies, reinterpret_cast<ErrorMatrix*>(out),
                                reinterpret_cast<ErrorMatrix*>(inverted));
    });
    auto [rows, to_rows] = make<int64_t>({weighed.size()});
    std::copy(weighed.begin(), weighed.end(), to_rows);
    return std::make_tuple(probabilities, P_seen, information_seen, rows);
}

}  // namespace

void bind_equations(nb::module_& m) {
    m.attr("CAUCHY") = kCauchy;
    m.attr("NOMINAL_WEIGHT") = kNominalWeight;
    m.def("predict", &predict_bodies);
    m.def("weigh_motions", &weigh_motions_of);
    m.def("are_own", &are_own);
    m.def("eliminate_robots", &eliminate_robots);
    m.def("inverses", &inverses);
}

}  // namespace roundel::fusion
