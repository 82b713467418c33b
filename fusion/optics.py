# SPDX-License-Identifier: BSD-3-Clause
"""What the cameras of a rig should see of discs in the world: the observation model and its derivatives.

The outline of a disc with centre c, unit normal n (camera frame) and radius r has the dual conic
C* = c c^T - r^2 (I - n n^T) (Hartley and Zisserman 2004, section 8.3; a disc is a flattened quadric). The outline's
centre is C* e_z: the projection of the point q = c + r^2 / c_z (n_z n - e_z), which is not the disc's own centre.

All of it happens in the undistorted plane x/z, y/z: `Frame.measure` takes detections there once, as they arrive.
Arrays hold one row's N columns last, (3, N) for N vectors, because numpy is several times faster along memory.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.camera import Camera
from fusion.state import OMEGA, POSITION, THETA, VELOCITY, States, turns
from fusion.undistortion import table_of

Array = NDArray[np.float64]
Index = NDArray[np.intp]
NEAR_M = 1e-3  # what is nearer than this to the lens's plane, or behind it, is not seen


@dataclass(frozen=True, slots=True, eq=False)
class Exposures:
    """F frames: the index of the camera (F,), and capture time less the states' time (F,), seconds."""

    camera: Index
    tau: Array


@dataclass(frozen=True, slots=True, eq=False)
class Discs:
    """N discs, each in one frame.

    Attributes:
        frame: (N,) row in the exposures.
        body: (N,) row in the states.
        row: (N,) tells markers apart.
        marker: (3, N) centre in the body's frame.
        radius: (N,) of the black disc, metres.
    """

    frame: Index
    body: Index
    row: Index
    marker: Array
    radius: Array

    def __len__(self) -> int:
        return len(self.frame)

    def select(self, rows: NDArray) -> "Discs":
        """The columns that a mask or an index array names."""
        return Discs(*taken(rows, *(getattr(self, name) for name in self.__slots__)))


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Every body in every frame, column f * n_bodies + b: rotation and translation to the camera, and to the world.

    `R_cam` and `R_world` (3, 3, K), `t_cam` (3, K).
    """

    n_bodies: int
    R_cam: Array
    t_cam: Array
    R_world: Array

    def columns(self, discs: Discs) -> Index:
        """(N,) which column is a disc's."""
        return discs.frame * self.n_bodies + discs.body


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """What N discs look like, camera frame: centre and normal (3, N), the outline's centre q (3, N) and xy (2, N).

    `xy` is NaN where a disc is not before its camera.
    """

    centre: Array
    normal: Array
    q: Array
    xy: Array

    def select(self, rows: NDArray) -> "Views":
        """The columns that a mask or an index array names."""
        return Views(*taken(rows, *(getattr(self, name) for name in self.__slots__)))

    @property
    def facing(self) -> Array:
        """(N,) cosine between the normal and the direction to the camera: above 0 if the print is visible."""
        along = np.einsum("in,in->n", self.normal, self.centre)
        return -along / np.sqrt(np.einsum("in,in->n", self.centre, self.centre))


class Optics:
    """The placed cameras of a rig, by index in the order of `names`."""

    def __init__(self, cameras: dict[str, Camera]) -> None:
        self.names = tuple(cameras)
        self.index = {name: k for k, name in enumerate(cameras)}
        self.cameras = tuple(cameras.values())
        for camera in self.cameras:
            table_of(camera)  # before the first frame has to wait for it
        self._set()

    def place(self, name: str, camera: Camera) -> None:
        """A camera stands elsewhere."""
        self.cameras = tuple(camera if k == self.index[name] else old for k, old in enumerate(self.cameras))
        self._set()

    def _set(self) -> None:
        T = np.array([camera.matrix() for camera in self.cameras]).reshape(-1, 4, 4)
        self.R_cam_world = T[:, :3, :3].transpose(0, 2, 1)
        self._R_cw = _rotations(self.R_cam_world)
        self.centres = T[:, :3, 3]
        self.focal = np.array([(camera.fx + camera.fy) / 2 for camera in self.cameras])

    def pose(self, states: States, exposures: Exposures) -> Poses:
        """Bodies at each frame's own time."""
        tau, R_cw, B = exposures.tau[:, None], self.R_cam_world[exposures.camera], len(states)
        R, v, omega = states.R.transpose(1, 2, 0), states.v.T, states.omega.T
        turn = turns(omega[:, None] * tau)  # (3, 3, F, B)
        R_world = (
            turn[:, 0, None] * R[0, :, None]
            + turn[:, 1, None] * R[1, :, None]
            + turn[:, 2, None] * R[2, :, None]
        )
        to = states.p.T[:, None] + v[:, None] * tau - self.centres[exposures.camera].T[:, :, None]
        # The cameras' rotations by one product each: (F, 3, 3) of (F, 3, 3 B) and (F, 3, B).
        R_cam = R_cw @ R_world.transpose(2, 0, 1, 3).reshape(-1, 3, 3 * B)
        t_cam = R_cw @ to.transpose(1, 0, 2)
        return Poses(
            B,
            R_cam.reshape(-1, 3, 3, B).transpose(1, 2, 0, 3).reshape(3, 3, -1),
            t_cam.transpose(1, 0, 2).reshape(3, -1),
            R_world.reshape(3, 3, -1),
        )

    def view(self, poses: Poses, discs: Discs) -> Views:
        """See `Views`."""
        at = poses.columns(discs)
        R = _take(poses.R_cam, at)
        c, n = _take(poses.t_cam, at) + np.einsum("ijn,jn->in", R, discs.marker), R[:, 2]
        q = n * (n[2] * discs.radius**2 / c[2])
        q[2] -= discs.radius**2 / c[2]
        q += c
        z = np.where(c[2] > NEAR_M, q[2], np.nan)
        return Views(c, n, q, q[:2] / z)

    def derive(self, poses: Poses, exposures: Exposures, discs: Discs, views: Views, whiten: Array) -> Array:
        """(2, 12, N) of the outline's centre, times `whiten` (2, 2, N), by the error of the disc's body.

        What moves by velocity in tau seconds moves tau times as by pose.
        """
        at, tau = poses.columns(discs), exposures.tau[discs.frame]
        by_centre, by_normal = _by_disc(views, discs.radius, whiten)
        R = _take(poses.R_cam, at)
        h, k = np.einsum("ain,ijn->ajn", by_centre, R), np.einsum("ain,ijn->ajn", by_normal, R)
        J = np.empty((2, 12, len(at)))
        x, y, z = discs.marker
        J[:, 0] = y * h[:, 2] - z * h[:, 1]  # h (w x m) = (m x h) w
        J[:, 1] = z * h[:, 0] - x * h[:, 2]
        J[:, 2] = x * h[:, 1] - y * h[:, 0]
        J[:, 0] -= k[:, 1]
        J[:, 1] += k[:, 0]
        R_cw = _take(self._R_cw, exposures.camera[discs.frame])
        J[:, POSITION] = np.einsum("ain,ijn->ajn", by_centre, R_cw)
        J[:, OMEGA] = tau * np.einsum("ain,jin->ajn", J[:, THETA], _take(poses.R_world, at))
        J[:, VELOCITY] = tau * J[:, POSITION]
        return J

    def rays(self, camera: Index, xy: Array) -> Array:
        """Unit viewing rays (N, 3) in the world of undistorted xy (2, N)."""
        rays = np.column_stack([*xy, np.ones(len(camera))])
        rays /= np.sqrt(np.einsum("ni,ni->n", rays, rays))[:, None]
        return np.einsum("nij,ni->nj", self.R_cam_world[camera], rays)


def _by_disc(views: Views, radius: Array, whiten: Array) -> tuple[Array, Array]:
    """Derivatives (2, 3, N) of the whitened outline's centre by the disc's centre and by its normal, camera frame.

    dq/dc = I - s/c_z e_z^T, dq/dn = r^2/c_z (n e_z^T + n_z I) with s = r^2/c_z (n_z n - e_z) = q - c.
    """
    g = np.empty((2, 3, len(radius)))
    g[:, :2] = whiten / views.q[2]
    g[:, 2] = -(g[:, 0] * views.xy[0] + g[:, 1] * views.xy[1])
    size = radius**2 / views.centre[2]
    by_normal = (size * views.normal[2]) * g
    by_normal[:, 2] += size * np.einsum("ain,in->an", g, views.normal)
    by_centre = g.copy()
    by_centre[:, 2] -= np.einsum("ain,in->an", g, views.q - views.centre) / views.centre[2]
    return by_centre, by_normal


def outlines(centre: Array, normal: Array, radius: Array, scale: Array) -> Array:
    """(N, 2, 2) shape matrices of discs' outlines in raw pixels; a circle of radius a has a^2 I.

    `centre` and `normal` (3, N) are in the camera's frame; `scale` (2, 2, N) is the derivative of raw pixels by xy at
    the disc: the lens is taken as affine over it.
    """
    dual = centre[:, None] * centre - radius**2 * (np.eye(3)[:, :, None] - normal[:, None] * normal)
    dual = dual / dual[2, 2]
    shape = dual[:2, None, 2] * dual[None, :2, 2] - dual[:2, :2]
    return np.einsum("ian,abn,jbn->nij", scale, shape, scale)


def measured_outlines(axes_px: Array, angle_rad: Array) -> Array:
    """(N, 2, 2) shape matrices of ellipses with full axes (2, N) and the major one's direction (N,)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    U = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    return U @ (U.transpose(0, 2, 1) * (axes_px.T[:, :, None] / 2) ** 2)


def shears(measured: Array, expected: Array) -> Array:
    """(2, N) of outlines (N, 2, 2) seen in the frame in which the expected one is a unit circle: 0 if similar.

    The two parts that change no area, divided by the size, each with a variance of 4 (sigma_axis / axis)^2.
    """
    l00 = np.sqrt(expected[:, 0, 0])  # L^-1 M L^-T by L L^T = the expected, written out: called for thousands
    l10 = expected[:, 1, 0] / l00
    l11 = np.sqrt(expected[:, 1, 1] - l10**2)
    a = measured[:, 0, 0] / l00**2
    b = (measured[:, 0, 1] / l00 - l10 * a) / l11
    c = (measured[:, 1, 1] - l10 * (2 * measured[:, 0, 1] / l00 - l10 * a)) / l11**2
    return np.stack([a - c, 2 * b]) / (np.sqrt(0.5) * (a + c))


def _rotations(R: Array) -> Array:
    """(..., 3, 3) -> (3, 3, K), memory along K."""
    return np.ascontiguousarray(R.reshape(-1, 3, 3).transpose(1, 2, 0))


def taken(rows: NDArray, *arrays: NDArray) -> Iterator[NDArray]:
    """The columns that a mask or an index array names, left along memory, as indexing would not leave them."""
    rows = np.flatnonzero(rows) if rows.dtype == bool else rows
    return (A.take(rows, -1) for A in arrays)


def _take(A: Array, columns: Index) -> Array:
    return np.take(A, columns, axis=-1)
