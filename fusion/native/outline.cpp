// SPDX-License-Identifier: BSD-3-Clause
#include "outline.hpp"

namespace roundel::fusion {

Shape outline(const Vector& c, const Vector& n, double radius, const Scale& s) {
    // With the centre m = C*_z / C*_zz of the conic: shape = m m^T - C*_xy / C*_zz.
    const double r2 = radius * radius, zz = c.z * c.z - r2 * (1 - n.z * n.z);
    const double mx = (c.x * c.z + r2 * n.x * n.z) / zz, my = (c.y * c.z + r2 * n.y * n.z) / zz;
    const double xx = mx * mx - (c.x * c.x - r2 * (1 - n.x * n.x)) / zz;
    const double xy = mx * my - (c.x * c.y + r2 * n.x * n.y) / zz;
    const double yy = my * my - (c.y * c.y - r2 * (1 - n.y * n.y)) / zz;
    return {s.ux * s.ux * xx + 2 * s.ux * s.uy * xy + s.uy * s.uy * yy,
            s.ux * s.vx * xx + (s.ux * s.vy + s.uy * s.vx) * xy + s.uy * s.vy * yy,
            s.vx * s.vx * xx + 2 * s.vx * s.vy * xy + s.vy * s.vy * yy};
}

Shape measured_outline(double major, double minor, double angle) {
    const double c = std::cos(angle), s = std::sin(angle), a = major * major / 4, b = minor * minor / 4;
    return {c * c * a + s * s * b, c * s * (a - b), s * s * a + c * c * b};
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
