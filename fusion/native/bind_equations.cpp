// SPDX-License-Identifier: BSD-3-Clause
#include <nanobind/stl/tuple.h>

#include <algorithm>

#include "arrays.hpp"
#include "motion.hpp"

namespace roundel::fusion {
namespace {

System system_of(const RowArray& rows, const Index& body, size_t n_bodies) {
    require_equal(rows.shape(0), {body.size()});
    return {reinterpret_cast<const Rows*>(rows.data()), below(n_bodies, body), body.size(), n_bodies};
}

auto sum_up(const RowArray& rows, const Index& body, const In<double, -1, 12, 12>& information,
            const In<double, -1, 12>& right, const Numbers& weights) {
    const size_t n = information.shape(0);
    const System system = system_of(rows, body, n);
    require_equal(n, {right.shape(0)});
    require_equal(body.size(), {weights.size()});
    auto [H, to_H] = make({n, kErrors, kErrors});
    auto [g, to_g] = make({n, kErrors});
    auto [w, to_w] = make({body.size()});
    std::copy_n(information.data(), information.size(), to_H);
    std::copy_n(right.data(), right.size(), to_g);
    std::copy_n(weights.data(), weights.size(), to_w);
    unlocked([&, to_H = to_H, to_g = to_g, to_w = to_w] {
        reweigh(system, reinterpret_cast<Square*>(to_H), reinterpret_cast<Step*>(to_g), to_w);
    });
    return std::make_tuple(H, g, w);
}

Out remainder_of(const RowArray& rows, const Index& body, const In<double, -1, 12>& steps) {
    const System system = system_of(rows, body, steps.shape(0));
    auto [left, to] = make({2, body.size()});
    unlocked([&] { remain(system, steps.data(), to); });
    return left;
}

Out inverses(const In<double, -1, 12, 12>& information) {
    auto [covariances, to] = make({information.shape(0), kErrors, kErrors});
    const auto* from = reinterpret_cast<const Square*>(information.data());
    unlocked([&, out = reinterpret_cast<Square*>(to)] {
        std::transform(from, from + information.shape(0), out, inverse);
    });
    return covariances;
}

auto predict_bodies(const In<double, -1, 3, 3>& R, const In<double, -1, 3>& p, const In<double, -1, 3>& omega,
                    const In<double, -1, 3>& v, const In<double, -1, 12, 12>& P, const Numbers& dt,
                    const In<double, -1, 2>& densities, const In<bool, -1>& single) {
    const size_t n = R.shape(0);
    require_equal(n, {p.shape(0), omega.shape(0), v.shape(0), P.shape(0), dt.size(), densities.shape(0),
                      single.size()});
    auto [R_then, to_R] = make({n, 3, 3});
    auto [p_then, to_p] = make({n, 3});
    auto [P_then, to_P] = make({n, kErrors, kErrors});
    auto [turn, to_turn] = make({n, 3, 3});
    std::copy_n(P.data(), P.size(), to_P);
    for (size_t b = 0; b < n; ++b) {
        Body body{matrix_at(R.data() + 9 * b), vector_at(p.data() + 3 * b), vector_at(omega.data() + 3 * b),
                  vector_at(v.data() + 3 * b)};
        const Drive drive{dt(b), densities(b, 0), densities(b, 1), single(b)};
        write(predict(body, reinterpret_cast<Square*>(to_P)[b], drive), to_turn + 9 * b);
        write(body.R, to_R + 9 * b);
        write(body.p, to_p + 3 * b);
    }
    return std::make_tuple(R_then, p_then, P_then, turn);
}

}  // namespace

void bind_equations(nb::module_& m) {
    m.attr("CAUCHY") = kCauchy;
    m.attr("NOMINAL_WEIGHT") = kNominalWeight;
    m.def("predict", &predict_bodies);
    m.def("reweigh", &sum_up);
    m.def("remainder", &remainder_of);
    m.def("inverses", &inverses);
}

}  // namespace roundel::fusion
