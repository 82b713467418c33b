// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "disc_view.hpp"

namespace roundel::fusion {

/// A symmetric matrix [xx xy; xy yy]. As the shape of an outline, a circle of radius a has a^2 I.
struct Shape {
    double xx, xy, yy;
};

/// The derivative of raw pixels by undistorted coordinates: the lens is taken as affine over an outline.
struct Scale {
    double ux, uy, vx, vy;

    static Scale of(const Columns<4>& scales, size_t k) {
        return {scales.at(0, k), scales.at(1, k), scales.at(2, k), scales.at(3, k)};
    }
};

/// Of a disc's outline, in raw pixels: the shape that its dual conic has.
Shape outline(const Vector& centre, const Vector& normal, double radius, const Scale& scale);
/// Of an ellipse with full axes and its major one's direction.
Shape measured_outline(double major, double minor, double angle);

/// The two parts of a difference between shapes that change no area, divided by the size.
struct Shear {
    double along, across;
};
/// An outline seen in the frame in which the expected one is a unit circle: 0 if they are similar. Each part
/// has a variance of 4 (sigma_axis / axis)^2.
Shear shear(const Shape& measured, const Shape& expected);

}  // namespace roundel::fusion
