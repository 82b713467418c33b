// SPDX-License-Identifier: BSD-3-Clause
#include "linearization.hpp"

namespace roundel::fusion {
namespace {

constexpr double kStep = 1e-4;  // rad, of the difference quotient of a shear

/// Derivatives of one coordinate of the centre of an outline by the centre of the disc and by its normal,
/// camera frame.
struct DiscDerivatives {
    Vector centre, normal;
};

/// Whitened by (wx, wy). With s = r^2/c_z (n_z n - e_z) = q - c:
/// dq/dc = I - s/c_z e_z^T, dq/dn = r^2/c_z (n e_z^T + n_z I).
DiscDerivatives differentiate(const DiscView& view, double radius, double wx, double wy) {
    const double gx = wx / view.q.z, gy = wy / view.q.z;
    const Vector g{gx, gy, -(gx * view.x + gy * view.y)};
    const double size = radius * radius / view.centre.z;
    DiscDerivatives by{g, (size * view.normal.z) * g};
    by.centre.z -= dot(g, view.q - view.centre) / view.centre.z;
    by.normal.z += size * dot(g, view.normal);
    return by;
}

void write(double* to, const Vector& v) { to[0] = v.x, to[1] = v.y, to[2] = v.z; }

/// Writes the row of one equation. The derivatives by the velocities are tau times those by the pose.
void write_row(const DiscDerivatives& by, const BodyInCamera& body, const Matrix& R_cam_world, double tau,
               const Vector& position, double* row) {
    const Vector h = by.centre * body.R_cam, k = by.normal * body.R_cam, &m = position;
    // h (w x m) = (m x h) w; the normal is the z axis of the body.
    const Vector theta{m.y * h.z - m.z * h.y - k.y, m.z * h.x - m.x * h.z + k.x, m.x * h.y - m.y * h.x};
    const Vector by_position = by.centre * R_cam_world;
    write(row, theta);
    write(row + 3, by_position);
    write(row + 6, tau * (body.R_world * theta));
    write(row + 9, tau * by_position);
}

/// Writes the two equations of a shear, by difference quotients over rotations about the axes x and y.
void write_shears(const Shear (&at)[3], double sigma, Equations& to) {
    const double weight = 1 / sigma, slope = weight / kStep;
    auto& [along, across] = to.A;
    along[0] = slope * (at[0].along - at[1].along), along[1] = slope * (at[0].along - at[2].along);
    across[0] = slope * (at[0].across - at[1].across), across[1] = slope * (at[0].across - at[2].across);
    along[kErrors] = weight * at[0].along, across[kErrors] = weight * at[0].across;
}

}  // namespace

void linearize(const FramePoses& poses, const CentreObservations& observed, Equations* to) {
    const Discs& discs = observed.discs;
    for (size_t k = 0; k < discs.size(); ++k) {
        const BodyInCamera body = poses.at(discs, k);
        const Vector position = discs.position.vector(k);
        const DiscView expected = view_disc(body, position, discs.radius[k]);
        const double x = observed.xy.at(0, k) - expected.x, y = observed.xy.at(1, k) - expected.y;
        to[k] = {};
        if (!std::isfinite(x + y)) continue;
        for (int a = 0; a < 2; ++a) {
            const double wx = observed.whiten.at(2 * a, k), wy = observed.whiten.at(2 * a + 1, k);
            double* row = to[k].A[a];
            write_row(differentiate(expected, discs.radius[k], wx, wy), body,
                      poses.exposures()[discs.frame[k]].R_cam_world, poses.tau(discs, k), position, row);
            if (observed.single[discs.body[k]]) write(row + 6, {0, 0, 0});
            row[kErrors] = wx * x + wy * y;
        }
    }
}

void linearize(const FramePoses& poses, const OutlineObservations& observed, Equations* to) {
    const Discs& discs = observed.discs;
    for (size_t k = 0; k < discs.size(); ++k) {
        const BodyInCamera body = poses.at(discs, k);
        const DiscView expected = view_disc(body, discs.position.vector(k), discs.radius[k]);
        to[k] = {};
        const Shape measured =
            measured_outline(observed.axes.at(0, k), observed.axes.at(1, k), observed.angle[k]);
        const Scale scale = Scale::of(observed.scale, k);
        const auto shear_at = [&](const Vector& normal) {
            return shear(measured, outline(expected.centre, normal, discs.radius[k], scale));
        };
        const Vector n = expected.normal;
        const Shear at[] = {shear_at(n), shear_at(n - kStep * body.R_cam.column1()),
                            shear_at(n + kStep * body.R_cam.column0())};
        const double sum = at[0].along + at[0].across + at[1].along + at[2].along;
        if (!std::isfinite(sum + expected.x)) continue;  // behind the camera, or seen edge-on
        write_shears(at, observed.sigma[k], to[k]);
    }
}

}  // namespace roundel::fusion
