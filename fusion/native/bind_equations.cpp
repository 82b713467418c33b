// SPDX-License-Identifier: BSD-3-Clause
#include <nanobind/stl/tuple.h>

#include <algorithm>

#include "arrays.hpp"
#include "normal_equations.hpp"

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

}  // namespace

void bind_equations(nb::module_& m) {
    m.attr("CAUCHY") = kCauchy;
    m.attr("NOMINAL_WEIGHT") = kNominalWeight;
    m.def("reweigh", &sum_up);
    m.def("remainder", &remainder_of);
    m.def("inverses", &inverses);
}

}  // namespace roundel::fusion
