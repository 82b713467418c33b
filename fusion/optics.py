# SPDX-License-Identifier: BSD-3-Clause
"""What the cameras of a rig should see of discs in the world: the observation model and its derivatives.

The outline of a disc with centre c, unit normal n (camera frame) and radius r has the dual conic
C* = c c^T - r^2 (I - n n^T) (Hartley and Zisserman 2004, section 8.3; a disc is a flattened quadric). The outline's
centre is C* e_z: the projection of the point q = c + r^2 / c_z (n_z n - e_z), which is not the disc's own centre.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.camera import Camera
from fusion.state import OMEGA, POSITION, THETA, VELOCITY, States, exp_so3, skew

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class Discs:
    """N discs as cameras see them, each at its own time.

    Attributes:
        camera: (N,) index of the camera.
        body: (N,) row in the states.
        marker: (N, 3) centre in the body's frame.
        radius: (N,) of the black disc, metres.
        tau: (N,) capture time less the states' time, seconds.
    """

    camera: Index
    body: Index
    marker: Array
    radius: Array
    tau: Array

    def select(self, rows: NDArray) -> "Discs":
        """The rows that a mask or an index array names."""
        return Discs(*(getattr(self, name)[rows] for name in self.__slots__))


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """What N discs look like.

    Attributes:
        uv: (N, 2) centre of the outline, raw pixels; NaN behind the camera.
        jacobian: (N, 2, 12) of `uv` by the error of the disc's body.
        major_px: (N,) full major axis.
        facing: (N,) cosine between the normal and the direction to the camera: above 0 if the print is visible.
    """

    uv: Array
    jacobian: Array
    major_px: Array
    facing: Array


class Optics:
    """The placed cameras of a rig, by index in the order of `names`."""

    def __init__(self, cameras: dict[str, Camera]) -> None:
        self.names = tuple(cameras)
        self.index = {name: k for k, name in enumerate(cameras)}
        self.cameras = tuple(cameras.values())
        T = np.array([camera.matrix() for camera in self.cameras]).reshape(-1, 4, 4)
        self.R_cam_world = T[:, :3, :3].transpose(0, 2, 1)
        self.centres = T[:, :3, 3]
        self.focal = np.array([(camera.fx + camera.fy) / 2 for camera in self.cameras])
        self.sizes = np.array([(camera.width, camera.height) for camera in self.cameras]).reshape(-1, 2)

    def view(self, states: States, discs: Discs) -> Views:
        """See `Views`."""
        R, arm, normal, centre = place(states, discs)
        R_cw = self.R_cam_world[discs.camera]
        to_disc = centre - self.centres[discs.camera]
        c, n = _rotate(R_cw, to_disc), _rotate(R_cw, normal)
        q, dq_dc, dq_dn = _outline_centre(c, n, discs.radius)
        uv, duv_dq = self.project(discs.camera, q)
        by_centre, by_normal = duv_dq @ dq_dc @ R_cw, duv_dq @ dq_dn @ R_cw
        range_m = np.linalg.norm(c, axis=1)
        return Views(
            uv,
            _by_error(by_centre, by_normal, R, arm, normal, discs),
            2 * self.focal[discs.camera] * discs.radius / np.maximum(c[:, 2], 1e-3),
            -np.einsum("ni,ni->n", normal, to_disc) / range_m,
        )

    def project(self, camera: Index, points: Array) -> tuple[Array, Array]:
        """Raw pixels (N, 2) of points (N, 3), each in its own camera's frame, and the derivative (N, 2, 3)."""
        uv, J = np.full((len(points), 2), np.nan), np.full((len(points), 2, 3), np.nan)
        for k, lens in enumerate(self.cameras):
            rows = np.flatnonzero(camera == k)
            if len(rows):
                uv[rows], J[rows] = lens.project_with_jacobian(points[rows])
        return uv, J

    def rays(self, camera: int, uv: Array) -> Array:
        """Unit viewing rays (N, 3) in the world."""
        return self.cameras[camera].rays(uv) @ self.R_cam_world[camera]

    def outlines(self, camera: Index, centre: Array, normal: Array, radius: Array) -> Array:
        """(N, 2, 2) shape matrices of discs' outlines in raw pixels; a circle of radius a has a^2 I.

        `centre` and `normal` (N, 3) are in the world. The lens is taken as affine over a disc.
        """
        R_cw = self.R_cam_world[camera]
        c, n = _rotate(R_cw, centre - self.centres[camera]), _rotate(R_cw, normal)
        dual = c[:, :, None] * c[:, None] - radius[:, None, None] ** 2 * (
            np.eye(3) - n[:, :, None] * n[:, None]
        )
        dual = dual / dual[:, 2:, 2:]
        middle = dual[:, :2, 2]
        J = self.project(camera, np.column_stack([middle, np.ones(len(middle))]))[1][:, :, :2]
        return J @ (middle[:, :, None] * middle[:, None] - dual[:, :2, :2]) @ J.transpose(0, 2, 1)


def measured_outlines(axes_px: Array, angle_rad: Array) -> Array:
    """(N, 2, 2) shape matrices of ellipses with full axes (N, 2) and the major one's direction (N,)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    U = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    return U @ (U.transpose(0, 2, 1) * (axes_px[:, :, None] / 2) ** 2)


def place(states: States, discs: Discs) -> tuple[Array, Array, Array, Array]:
    """At each disc's own time: the body's rotation, and in the world the disc's arm, normal and centre."""
    body, tau = discs.body, discs.tau[:, None]
    R = exp_so3(states.omega[body] * tau) @ states.R[body]
    arm = _rotate(R, discs.marker)
    return R, arm, R[:, :, 2], states.p[body] + states.v[body] * tau + arm


def _outline_centre(c: Array, n: Array, radius: Array) -> tuple[Array, Array, Array]:
    """The point q (N, 3) that projects to the outline's centre, and its derivatives (N, 3, 3) by c and n."""
    e = np.array([0.0, 0.0, 1.0])
    size = (radius**2 / c[:, 2])[:, None]
    shift = n[:, 2:] * n - e
    dq_dc = np.eye(3) - (size / c[:, 2:] * shift)[:, :, None] * e
    dq_dn = size[:, :, None] * (n[:, :, None] * e + n[:, 2:, None] * np.eye(3))
    return c + size * shift, dq_dc, dq_dn


def _by_error(by_centre: Array, by_normal: Array, R: Array, arm: Array, normal: Array, discs: Discs) -> Array:
    """(N, 2, 12): what moves by velocity in tau seconds moves tau times as by pose."""
    J = np.empty((len(arm), 2, 12))
    turning = -(by_centre @ skew(arm) + by_normal @ skew(normal))  # by a rotation in the world
    tau = discs.tau[:, None, None]
    J[:, :, THETA] = turning @ R
    J[:, :, POSITION] = by_centre
    J[:, :, OMEGA] = tau * turning
    J[:, :, VELOCITY] = tau * by_centre
    return J


def _rotate(R: Array, vectors: Array) -> Array:
    return np.einsum("nij,nj->ni", R, vectors)
