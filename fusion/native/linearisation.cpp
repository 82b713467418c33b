// SPDX-License-Identifier: BSD-3-Clause
#include "linearisation.hpp"

namespace roundel::fusion {
namespace {

constexpr double kStep = 1e-4;  // rad, of the difference quotient of an outline's shape

/// Derivatives of one coordinate of the outline's centre by the disc's centre and by its normal, camera
/// frame.
struct ByDisc {
    Vector centre, normal;
};

/// Whitened by (wx, wy). With s = r^2/c_z (n_z n - e_z) = q - c:
/// dq/dc = I - s/c_z e_z^T, dq/dn = r^2/c_z (n e_z^T + n_z I).
ByDisc differentiate(const View& seen, double radius, double wx, double wy) {
    const double gx = wx / seen.q.z, gy = wy / seen.q.z;
    const Vector g{gx, gy, -(gx * seen.x + gy * seen.y)};
    const double size = radius * radius / seen.centre.z;
    ByDisc by{g, (size * seen.normal.z) * g};
    by.centre.z -= dot(g, seen.q - seen.centre) / seen.centre.z;
    by.normal.z += size * dot(g, seen.normal);
    return by;
}

void write(double* to, const Vector& v) { to[0] = v.x, to[1] = v.y, to[2] = v.z; }

/// One equation's row by the body's error. What moves by velocity in tau seconds moves tau times as by pose.
void derive(const ByDisc& by, const Placed& body, const Exposure& exposure, const Vector& m, double* row) {
    const Vector h = by.centre * body.R_cam, k = by.normal * body.R_cam;
    // h (w x m) = (m x h) w, and n turns likewise about the body's z.
    const Vector theta{m.y * h.z - m.z * h.y - k.y, m.z * h.x - m.x * h.z + k.x, m.x * h.y - m.y * h.x};
    const Vector position = by.centre * exposure.R_cam_world;
    write(row, theta);
    write(row + 3, position);
    write(row + 6, exposure.tau * (body.R_world * theta));
    write(row + 9, exposure.tau * position);
}

}  // namespace

void linearise(const Poses& poses, const Centres& seen, Rows* to) {
    const Discs& discs = seen.discs;
    for (size_t k = 0; k < discs.size(); ++k) {
        const Placed& body = poses.at(discs.frame[k], discs.body[k]);
        const Vector marker = discs.marker.vector(k);
        const View expected = view(body, marker, discs.radius[k]);
        const double x = seen.xy.at(0, k) - expected.x, y = seen.xy.at(1, k) - expected.y;
        to[k] = {};
        if (!std::isfinite(x + y)) continue;
        for (int a = 0; a < 2; ++a) {
            const double wx = seen.whiten.at(2 * a, k), wy = seen.whiten.at(2 * a + 1, k);
            double* row = to[k].A[a];
            derive(differentiate(expected, discs.radius[k], wx, wy), body, poses.exposures()[discs.frame[k]],
                   marker, row);
            if (seen.single[discs.body[k]]) write(row + 6, {0, 0, 0});
            row[kErrors] = wx * x + wy * y;
        }
    }
}

void linearise(const Poses& poses, const Outlines& seen, Rows* to) {
    const Discs& discs = seen.discs;
    for (size_t k = 0; k < discs.size(); ++k) {
        const Placed& body = poses.at(discs.frame[k], discs.body[k]);
        const View expected = view(body, discs.marker.vector(k), discs.radius[k]);
        to[k] = {};
        const Shape measured = measured_outline(seen.axes.at(0, k), seen.axes.at(1, k), seen.angle[k]);
        const Scale scale = Scale::of(seen.scale, k);
        const auto at = [&](const Vector& normal) {
            return shear(measured, outline(expected.centre, normal, discs.radius[k], scale));
        };
        const Vector n = expected.normal;
        const Shear here = at(n), about_x = at(n - kStep * body.R_cam.column1()),
                    about_y = at(n + kStep * body.R_cam.column0());
        const double any = here.along + here.across + about_x.along + about_y.along;
        if (!std::isfinite(any + expected.x)) continue;  // not before its camera, or seen from its edge
        const double weight = 1 / seen.sigma[k], slope = weight / kStep;
        auto& [along, across] = to[k].A;
        along[0] = slope * (here.along - about_x.along), along[1] = slope * (here.along - about_y.along);
        across[0] = slope * (here.across - about_x.across),
        across[1] = slope * (here.across - about_y.across);
        along[kErrors] = weight * here.along, across[kErrors] = weight * here.across;
    }
}

}  // namespace roundel::fusion
