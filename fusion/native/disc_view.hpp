// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <limits>
#include <vector>

#include "columns.hpp"

/// What a camera should see of a disc, in the undistorted plane x/z, y/z.
///
/// The outline of a disc with centre c, unit normal n (camera frame) and radius r has the dual conic
/// C* = c c^T - r^2 (I - n n^T) (Hartley and Zisserman 2004, section 8.3; a disc is a flattened quadric). The
/// outline's centre is C* e_z: the projection of q = c + r^2 / c_z (n_z n - e_z), not the disc's own centre.
namespace roundel::fusion {

constexpr double kNearM = 1e-3;  // what is nearer than this to the lens's plane, or behind it, is not seen

/// A camera at a capture time `tau` seconds after the states'.
struct Exposure {
    Matrix R_cam_world;
    Vector centre;  // of the camera, in the world
    double tau;
};

/// A moving body: R and p in the world at the states' time, turning rate and velocity in the world.
struct Body {
    Matrix R;
    Vector p, omega, v;
};

/// A body in an exposure: x_cam = R_cam x_body + t_cam at the exposure's own time; R_world the body's turn
/// then.
struct Placed {
    Matrix R_cam, R_world;
    Vector t_cam;
};
Placed place(const Body& body, const Exposure& exposure);

/// See above; `x` and `y` are NaN where the disc is not before its camera.
struct View {
    Vector centre, normal, q;
    double x, y;

    /// Cosine between the normal and the direction to the camera: above 0 if the print is visible.
    double facing() const { return -dot(normal, centre) / std::sqrt(dot(centre, centre)); }
};
View view(const Placed& body, const Vector& marker, double radius);

/// Every body in every exposure.
class Poses {
  public:
    Poses(std::vector<Body> bodies, std::vector<Exposure> exposures);

    size_t n_bodies() const { return n_bodies_; }
    const std::vector<Exposure>& exposures() const { return exposures_; }
    const Placed& at(size_t frame, size_t body) const { return placed_[frame * n_bodies_ + body]; }

  private:
    size_t n_bodies_;
    std::vector<Exposure> exposures_;
    std::vector<Placed> placed_;
};

/// N discs, each in one frame and of one body, at `marker` in the body's frame.
struct Discs {
    const int64_t *frame, *body;
    Columns<3> marker;
    const double* radius;

    size_t size() const { return marker.n; }
};

/// What discs look like: 11 rows of N columns, centre, normal, q, x and y.
void view_all(const Poses& poses, const Discs& discs, double* to);

}  // namespace roundel::fusion
