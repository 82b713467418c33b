# SPDX-License-Identifier: BSD-3-Clause
"""A camera: a lens with a pose and a clock offset, the Jacobians of its pixels, and the pose of a body in one view."""

from collections.abc import Sequence
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import ArrayLike

from camera_node.foundation.arrays import Array, Mask
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import Pose, invert, motion_from, skew

AnyLens = TypeVar("AnyLens", bound=Lens)

# The parameters of one camera, by their columns in every Jacobian and covariance: rotation and translation in the
# camera's own frame, time offset, clock drift, readout time, and of the lens: log focal length (mean of fx and fy), cx,
# cy, k1, log fx / fy, and the four distortion coefficients after k1, of which a fisheye has three.
POSE, OFFSET, DRIFT, READOUT, LENS = tuple(range(6)), (6,), (7,), (8,), tuple(range(9, 18))
PER_CAMERA = 18

# How far focus, temperature and remounting move a lens from its own calibration: relative focal length, pixels of the
# principal point, and distortion coefficients (k1, k2, p1, p2, k3 of a pinhole lens).
FOCAL_STABILITY, CENTRE_STABILITY, DISTORTION_STABILITY = 5e-4, 0.3, (5e-4, 2e-4, 2e-5, 2e-5, 2e-4)

MIN_MARKERS = 4  # of a view, that give a body's pose
NEAREST_M = 1e-3  # a marker nearer to its camera counts as behind it: inside a lens it would fit any pixel
FLAT = 0.01  # of the extent of points: those nearer to a line or a plane lie on it


class Camera(Lens, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """A lens with its pose in the world and the offset of its clock.

    Attributes:
        T_world_cam: the pose; None before the camera is calibrated.
        time_offset_ms: true capture time = stamp + offset.
        time_drift_ppm, time_reference_ns: of stamps that no server synchronises, as of videos with another rate than
            stated: the offset grows by this from the reference, a stamp (`capture_ns`).
        readout_us: time in which a rolling shutter reads all rows, microseconds, negative from the last to the first:
            the row at height h of the image (`image_row`) is captured h readout times later. None: as the camera says.
        covariance: (6, 6) of the pose in GTSAM's tangent order (rotation, then translation, both in the camera's
            frame), rad and m; None where unknown.
        errors: (8, n) rows of a factor L of the covariance L L^T of the errors of all cameras of the rig, with the
            cross terms: rotation and translation as in `covariance`, clock offset (s) and logarithm of the focal
            length. They contain errors of the lens, as those that look alike (`calib.rig.camera_errors`). None where
            unknown.
        lens_sigma: standard deviations of the lens's `parameters`, in their order; None where never measured.
    """

    T_world_cam: Pose | None = None
    time_offset_ms: float = 0.0
    time_drift_ppm: float = 0.0
    time_reference_ns: int = 0
    readout_us: float | None = None
    covariance: tuple[tuple[float, ...], ...] | None = None
    errors: tuple[tuple[float, ...], ...] | None = None
    lens_sigma: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        sigma = self.lens_sigma
        if sigma is not None and not (len(sigma) >= 4 and np.isfinite(sigma).all() and min(sigma) >= 0):
            raise ValueError(
                "lens_sigma must hold the standard deviations of fx, fy, cx, cy and the distortion coefficients"
            )

    def project_world(self, p_world: ArrayLike) -> Array:
        """Raw pixels (N, 2) of points (N, 3) in the world; NaN for points that are not in front of the camera."""
        return self.project(transform(invert(self.matrix()), p_world))

    def sees(self, uv: ArrayLike) -> Mask:
        """(N,) whether pixels (N, 2) lie in the image; False for NaN."""
        uv = np.asarray(uv, float).reshape(-1, 2)
        inside = (uv >= -0.5) & (uv < [self.width - 0.5, self.height - 0.5])
        return inside[:, 0] & inside[:, 1]

    @property
    def clock(self) -> tuple[float, float, int]:
        """The offset, the drift and the reference of the stamps."""
        return self.time_offset_ms, self.time_drift_ppm, self.time_reference_ns

    def capture_ns(self, t_ns: int, sent_ns: int = 0) -> int:
        """The true capture time of a stamp, ns. A camera node, which states when it sent the message (`sent_ns`), has
        the server's time: the drift of a recording does not hold for it."""
        since_ns = 0 if sent_ns else t_ns - self.time_reference_ns
        return t_ns + round(1e6 * self.time_offset_ms + 1e-6 * self.time_drift_ppm * since_ns)

    def readout_s(self, stated_us: float) -> float:
        """The readout time, s: the calibrated one, or `stated_us`, microseconds, of the camera's own messages."""
        return 1e-6 * (stated_us if self.readout_us is None else self.readout_us)

    def matrix(self) -> Array:
        """T_world_cam as a (4, 4) matrix.

        Raises:
            ValueError: the camera has no pose.
        """
        if self.T_world_cam is None:
            raise ValueError("the camera has no pose")
        return self.T_world_cam.matrix()


def stated_sigma(lens: Lens, sigma: Sequence[float]) -> tuple[float, ...]:
    """`Camera.lens_sigma` of a lens whose own calibration has standard deviations `sigma`, in the order of its
    `parameters`: those, but not below the stability of a lens in use, because who reads the file takes it literally."""
    rest = (*DISTORTION_STABILITY, *[0.0] * len(sigma))
    stability = (FOCAL_STABILITY * lens.fx, FOCAL_STABILITY * lens.fy, *[CENTRE_STABILITY] * 2, *rest)
    return tuple(float(max(pair)) for pair in zip(sigma, stability, strict=False))


def span_dimension(points: Array) -> int:
    """The dimension of the span of points (n, 3), to a hundredth of its extent: 0 of points that coincide, 1 of a line,
    2 of a plane."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return int((spread > max(FLAT * spread[0], 1e-6)).sum())


def transform(T: Array, points: ArrayLike) -> Array:
    """Points (N, 3) moved by the rigid motion T (4, 4)."""
    return np.asarray(points, float).reshape(-1, 3) @ T[:3, :3].T + T[:3, 3]


def solve_view(points: Array, xy: Array) -> list[Array]:
    """Poses (4, 4) of a body in a camera, the better one first, from image plane coordinates (n, 2) of its points
    (n, 3); none where they do not determine it."""
    if len(points) < MIN_MARKERS or (rank := span_dimension(points)) < 2:
        return []
    method, given = cv2.SOLVEPNP_SQPNP, points
    if rank == 2:  # IPPE needs points that are exactly in a plane
        off = points - points.mean(axis=0)
        normal = np.linalg.svd(off)[2][2]
        method, given = cv2.SOLVEPNP_IPPE, points - np.outer(off @ normal, normal)
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(given, xy, np.eye(3), None, flags=method)
    except cv2.error:
        return []
    found = []
    for turn, shift in zip(turns, shifts, strict=True):
        T = motion_from(turn, shift)
        if np.isfinite(T).all() and (transform(T, points)[:, 2] > 0).all():
            found.append(T)
    return found


def pixel_jacobians(lens: Lens, points: ArrayLike) -> tuple[Array, Array, Array, Array]:
    """Project points (N, 3), camera frame, with all derivatives.

    Returns:
        uv: (N, 2) raw pixels.
        J_point: (N, 2, 3) by the point, in the camera's frame.
        J_pose: (N, 2, 6) by a rotation w and a translation t of the camera in its own frame, which move points in
            that frame by p x w - t.
        J_lens: (N, 2, 9) by the parameters of the lens (`LENS`).
        All are NaN for points that are not in front of the camera.
    """
    lens, points = with_distortion(lens), np.asarray(points, float).reshape(-1, 3)
    uv, J_point, by_lens = lens.project_with_jacobians(points)
    J_pose = np.concatenate([J_point @ skew(points), -J_point], axis=2)
    fx, fy = by_lens[:, :, :1] * lens.fx, by_lens[:, :, 1:2] * lens.fy
    higher = np.zeros((len(points), 2, len(LENS) - 5))
    present = by_lens[:, :, 5:9]
    higher[:, :, : present.shape[2]] = present
    J_lens = np.concatenate([fx + fy, by_lens[:, :, 2:5], (fx - fy) / 2, higher], axis=2)
    return uv, J_point, J_pose, J_lens


def with_distortion(lens: AnyLens) -> AnyLens:
    """The same lens with the distortion coefficients that are adjusted, zeros where it has none: k1, k2, p1, p2, k3 of
    a pinhole lens, k1 to k4 of a fisheye."""
    missing = (5 if lens.model == "pinhole" else 4) - len(lens.distortion)
    return lens.with_parameters([*lens.parameters, *[0.0] * missing]) if missing > 0 else lens


def lens_parameters(lens: Lens) -> Array:
    """(9,) the parameters of a lens that `LENS` numbers."""
    distortion = with_distortion(lens).distortion
    focal, ratio = np.log(lens.fx * lens.fy) / 2, np.log(lens.fx / lens.fy)
    higher = (*distortion[1:5], 0.0)[:4]
    return np.array([focal, lens.cx, lens.cy, distortion[0], ratio, *higher])
