// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "disc_view.hpp"
#include "numeric/ellipse.hpp"

namespace roundel::fusion {

/// The shape matrix of an ellipse; that of a circle of radius a is a^2 I.
using Shape = Symmetric;

/// The Jacobian of raw pixels with respect to undistorted coordinates. The lens is taken as affine over an
/// outline.
using Scale = LinearMap;

inline Scale scale_at(const Columns<4>& scales, size_t k) {
    return {scales.at(0, k), scales.at(1, k), scales.at(2, k), scales.at(3, k)};
}

/// The shape matrix of the outline of a disc, raw pixels, from its dual conic.
Shape outline(const Vector& centre, const Vector& normal, double radius, const Scale& scale);
/// The shape matrix of an ellipse with the given full axes; `angle` is the direction of the major axis.
Shape measured_outline(double major, double minor, double angle);

/// The two components of the difference of two shapes that do not change the area, divided by the size.
struct Shear {
    double along, across;
};
/// Compares a measured shape with an expected one, in coordinates in which the expected one is a unit
/// circle. Similar shapes give 0. Each component has the variance 4 (sigma_axis / axis)^2.
Shear shear(const Shape& measured, const Shape& expected);

}  // namespace roundel::fusion
