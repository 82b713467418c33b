// SPDX-License-Identifier: BSD-3-Clause
#include "outline.hpp"

#include "numeric/disc_outline.hpp"

namespace roundel::fusion {

Shape outline(const Vector& centre, const Vector& normal, double radius, const Scale& scale) {
    return mapped(scale, ellipse_of(dual_conic_of(centre, normal, radius)).shape);
}

Shape measured_outline(double major, double minor, double angle) {
    return from_eigenvalues(major * major / 4, minor * minor / 4, angle);
}

Shear shear(const Shape& measured, const Shape& expected) {
    // L^-1 M L^-T, where L L^T is the expected shape.
    const double l00 = std::sqrt(expected.xx), l10 = expected.xy / l00,
                 l11 = std::sqrt(expected.yy - l10 * l10);
    const double a = measured.xx / expected.xx, b = (measured.xy / l00 - l10 * a) / l11;
    const double c = (measured.yy - l10 * (2 * measured.xy / l00 - l10 * a)) / (l11 * l11);
    const double size = std::sqrt(0.5) * (a + c);
    return {(a - c) / size, 2 * b / size};
}

}  // namespace roundel::fusion
