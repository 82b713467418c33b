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

void write(double* to, const Vector& v) {
    to[0] = v.x;
    to[1] = v.y;
    to[2] = v.z;
}

/// Writes the row of one equation. The derivatives by the velocities are tau times those by the pose.
void write_row(const DiscDerivatives& by, const BodyInCamera& body, const Exposure& exposure,
               const DiscOnBody& disc, double* row) {
    const Vector h = by.centre * body.R_cam, k = by.normal * body.R_cam;
    const Vector theta = cross(disc.position, h) + cross(disc.normal, k);  // h (w x m) = (m x h) w
    const Vector by_position = by.centre * exposure.R_cam_world;
    write(row, theta);
    write(row + 3, by_position);
    write(row + 6, exposure.tau * (body.R_world * theta));
    write(row + 9, exposure.tau * by_position);
}

/// Two unit vectors in the plane of a disc, so that (first, second, normal) is right-handed; body frame.
struct PlaneAxes {
    Vector first, second;

    static PlaneAxes of(const Vector& normal) {
        const Vector beside = std::abs(normal.x) < 0.7 ? Vector{1, 0, 0} : Vector{0, 1, 0};
        const Vector across = cross(normal, beside), second = (1 / std::sqrt(dot(across, across))) * across;
        return {cross(second, normal), second};
    }
};

/// Writes the two equations of a shear, by difference quotients over rotations about the axes of the plane.
void write_shears(const Shear (&at)[3], const PlaneAxes& about, double sigma, Equations& to) {
    const double weight = 1 / sigma, slope = weight / kStep;
    auto& [along, across] = to.A;
    const auto slopes = [&](double first, double second) {
        return slope * (first * about.first + second * about.second);
    };
    write(along, slopes(at[0].along - at[1].along, at[0].along - at[2].along));
    write(across, slopes(at[0].across - at[1].across, at[0].across - at[2].across));
    along[kErrors] = weight * at[0].along;
    across[kErrors] = weight * at[0].across;
}

}  // namespace

Equations linearize(const FramePoses& poses, const CentreObservations& observed, size_t k) {
    const Discs& discs = observed.discs;
    const Exposure exposure = poses.exposure(discs, k);
    const BodyInCamera body = poses.at(discs, k);
    const DiscOnBody disc = discs.at(k);
    const DiscView expected = view_disc(body, disc);
    const double x = observed.xy.at(0, k) - expected.x, y = observed.xy.at(1, k) - expected.y;
    Equations to{};
    if (!std::isfinite(x + y)) return to;
    for (int a = 0; a < 2; ++a) {
        const double wx = observed.whiten.at(2 * a, k), wy = observed.whiten.at(2 * a + 1, k);
        double* row = to.A[a];
        write_row(differentiate(expected, disc.radius, wx, wy), body, exposure, disc, row);
        if (observed.single[discs.body[k]]) write(row + 6, {0, 0, 0});
        row[kErrors] = wx * x + wy * y;
    }
    return to;
}

void differentiate(const FramePoses& poses, const Discs& discs, Columns<4> whiten, Columns<2> by_focal,
                   CameraDerivatives* to) {
    for (size_t k = 0; k < discs.size(); ++k) {
        const BodyInCamera body = poses.at(discs, k);
        const DiscOnBody disc = discs.at(k);
        const DiscView expected = view_disc(body, disc);
        to[k] = {};
        if (!std::isfinite(expected.x + expected.y)) continue;
        const Vector velocity = body.v_cam + cross(body.omega_cam, body.R_cam * disc.position);
        const Vector turning = cross(body.omega_cam, expected.normal);
        for (int a = 0; a < 2; ++a) {
            const double wx = whiten.at(2 * a, k), wy = whiten.at(2 * a + 1, k);
            const DiscDerivatives by = differentiate(expected, disc.radius, wx, wy);
            double* row = to[k].B[a];
            write(row, cross(by.centre, expected.centre) + cross(by.normal, expected.normal));
            write(row + 3, -1.0 * by.centre);
            row[6] = dot(by.centre, velocity) + dot(by.normal, turning);
            row[7] = wx * by_focal.at(0, k) + wy * by_focal.at(1, k);
        }
    }
}

Equations linearize(const FramePoses& poses, const OutlineObservations& observed, size_t k) {
    const Discs& discs = observed.discs;
    const BodyInCamera body = poses.at(discs, k);
    const DiscView expected = view_disc(body, discs.at(k));
    const Shape measured =
        measured_outline(observed.axes.at(0, k), observed.axes.at(1, k), observed.angle[k]);
    const Scale scale = scale_at(observed.scale, k);
    const auto shear_at = [&](const Vector& normal) {
        return shear(measured, outline(expected.centre, normal, discs.radius[k], scale));
    };
    const Vector n = expected.normal;
    const PlaneAxes about =
        PlaneAxes::of(discs.normal.vector(k));  // a rotation about one moves n by the other
    const Shear at[] = {shear_at(n), shear_at(n - kStep * (body.R_cam * about.second)),
                        shear_at(n + kStep * (body.R_cam * about.first))};
    Equations to{};
    const double sum = at[0].along + at[0].across + at[1].along + at[2].along;
    // Otherwise it is behind the camera, or seen edge-on.
    if (std::isfinite(sum + expected.x)) write_shears(at, about, observed.sigma[k], to);
    return to;
}

}  // namespace roundel::fusion
