// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <limits>
#include <memory>
#include <vector>

#include "columns.hpp"

/// Projects discs into cameras, in the undistorted image plane x/z, y/z; see numeric/disc_outline.hpp.
namespace roundel::fusion {

constexpr double kNearM = 1e-3;  // discs with a smaller depth are not visible

/// The pose of a camera at one capture time.
struct Exposure {
    Matrix R_cam_world;
    Vector centre;     // of projection, world frame
    double tau;        // capture time minus the time of the body states, seconds
    double tau_sigma;  // standard deviation of the capture time, seconds
};

/// The state of a moving body, world frame.
struct Body {
    Matrix R;
    Vector p, omega, v;
};

/// A body at the capture time of an exposure: x_cam = R_cam x_body + t_cam.
struct BodyInCamera {
    Matrix R_cam, R_world;
    Vector t_cam;
    Vector omega_cam;  // angular velocity, camera frame
    Vector v_cam;      // velocity, camera frame
};
BodyInCamera transform(const Body& body, const Exposure& exposure);

/// Where a disc is on its body: centre and unit normal out of the print, body frame; radius of the disc.
struct DiscOnBody {
    Vector position, normal;
    double radius;
};

/// A projected disc: `q` is its `outline_centre`, and `x` and `y` its image, NaN where the disc is behind the
/// camera.
struct DiscView {
    Vector centre, normal, q;
    double x, y;

    /// Cosine between the normal and the direction to the camera: positive where the print is visible.
    double facing() const { return -dot(normal, centre) / std::sqrt(dot(centre, centre)); }
};
DiscView view_disc(const BodyInCamera& body, const DiscOnBody& disc);

/// The poses of all bodies at the capture times of all exposures, each computed when it is first needed: by
/// one thread at a time.
class FramePoses {
  public:
    FramePoses(const std::vector<Body>& bodies, const std::vector<Exposure>& exposures);

    size_t n_bodies() const { return n_bodies_; }
    const std::vector<Body>& bodies() const { return bodies_; }
    const std::vector<Exposure>& exposures() const { return exposures_; }
    const BodyInCamera& at(size_t frame, size_t body) const {
        const size_t k = frame * n_bodies_ + body;
        if (!is_known_[k]) {
            poses_[k] = transform(bodies_[body], exposures_[frame]);
            is_known_[k] = true;
        }
        return poses_[k];
    }
    /// The pose of the body of disc `k` when its image was captured.
    BodyInCamera at(const struct Discs& discs, size_t k) const;
    /// The exposure of the row of disc `k`.
    Exposure exposure(const struct Discs& discs, size_t k) const;

  private:
    size_t n_bodies_;
    std::vector<Body> bodies_;
    std::vector<Exposure> exposures_;
    std::unique_ptr<BodyInCamera[]> poses_;  // not initialized, unlike those of a vector
    mutable std::vector<char> is_known_;
};

/// N discs, each in one frame and on one body. `position` and the unit `normal` are in the frame of the body;
/// `delay` is the time from the frame to the capture of the disc's row by a rolling shutter, seconds.
struct Discs {
    const int64_t *frame, *body;
    Columns<3> position, normal;
    const double *radius, *delay;

    size_t size() const { return position.n; }
    DiscOnBody at(size_t k) const { return {position.vector(k), normal.vector(k), radius[k]}; }
};

/// Writes 11 rows of N columns: centre, normal, q, x and y of each disc.
void view_discs(const FramePoses& poses, const Discs& discs, double* to);

}  // namespace roundel::fusion
