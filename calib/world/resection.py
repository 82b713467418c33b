# SPDX-License-Identifier: BSD-3-Clause
"""Places one camera by roundels at known positions, such as on the floor (resection; Hartley and Zisserman, chapter 7).

Roundels need no numbers: each assignment of three roundels to three points gives up to four poses (P3P), and the one
under which most points have a roundel wins. A pose needs four points; its covariance counts the errors of the points,
of the detections and of the lens.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations

import cv2
import msgspec
import numpy as np

from calib.errors import CalibrationError
from calib.rig.camera import MIN_MARKERS, Camera, pixel_jacobians, solve_view, span_dimension, transform
from calib.rig.estimation import MARGIN, STEPS, rms
from calib.world.landmarks import FIT_PX
from calib.world.still_roundels import StillRoundel
from camera_node.foundation.arrays import Array, Index
from camera_node.geometry.pose import Pose, invert, motion_from, rotation_angle, rotation_from_vector

SIGMA_PX = 0.2  # of a mean centre: the centre of the ellipse is not exactly that of the disc
MAX_ASSIGNMENTS = 20_000  # of three roundels to three points: a few seconds
# RMS distance of the points from their rays over their extent: beyond, names or units are wrong
MAX_MISS = 0.05


@dataclass(frozen=True, slots=True)
class Resection:
    """A camera placed by points.

    Attributes:
        camera: with its pose in the world of the points, and the covariance of that pose.
        misses_m: distance of each point from the ray of its roundel, metres, by name.
    """

    camera: Camera
    misses_m: dict[str, float]


def place_by_points(
    name: str,
    camera: Camera,
    roundels: Sequence[StillRoundel],
    points: Mapping[str, Array],
    sigma_m: float,
) -> Resection:
    """Place a camera by the stationary roundels that it sees.

    Args:
        name: of the camera, in errors.
        camera: its lens; a pose that it has is not used.
        roundels: of this camera; one with the name of a point is that one.
        points: (3,) by name, metres, world.
        sigma_m: standard deviation of one coordinate of a point.

    Raises:
        CalibrationError: fewer than four points are seen, they lie on a line, or two poses fit them.
    """
    places, pixels = np.array(list(points.values()), float), np.array([r.uv for r in roundels]).reshape(-1, 2)
    row = {roundel.name: k for k, roundel in enumerate(roundels)}
    rows = np.array([row.get(point, -1) for point in points], np.intp)
    if not (rows >= 0).any():
        rows = _assign(name, camera, pixels, places)
    seen = np.flatnonzero(rows >= 0)
    if len(seen) < MIN_MARKERS or span_dimension(places[seen]) < 2:
        raise CalibrationError(
            f"camera '{name}' sees {len(seen)} of the points; its pose needs {MIN_MARKERS} that are not on a line"
        )
    fit = _fit_uniquely(name, camera, pixels[rows[seen]], places[seen], sigma_m)
    misses = fit.misses_m()
    extent = float(np.linalg.norm(np.ptp(places[seen], axis=0)))
    if rms(misses) > MAX_MISS * extent:
        raise CalibrationError(
            f"camera '{name}': the points are {1e3 * rms(misses):.0f} mm from its rays; check their "
            "names, units (metres) and axes (z up), and the lens"
        )
    placed = msgspec.structs.replace(
        camera, T_world_cam=Pose.from_matrix(fit.T), covariance=tuple(map(tuple, fit.covariance().tolist()))
    )
    names = [list(points)[k] for k in seen]
    return Resection(placed, dict(zip(names, misses.tolist(), strict=True)))


def _assign(name: str, camera: Camera, pixels: Array, places: Array) -> Index:
    """(N,) the roundel of each point, -1 where none is, under the pose that fits most points.

    Raises:
        CalibrationError: there are too many roundels, too few of them fit, or two assignments fit as well.
    """
    chosen = [rows for rows in combinations(range(len(places)), 3) if span_dimension(places[list(rows)]) == 2]
    count = len(pixels) * max(len(pixels) - 1, 0) * max(len(pixels) - 2, 0)
    if len(chosen) * count > MAX_ASSIGNMENTS:
        raise CalibrationError(
            f"camera '{name}' sees {len(pixels)} stationary roundels, which is too many to try; mask the others, or "
            "number the roundels in the observations"
        )
    xy = camera.normalise(pixels)
    found: dict[tuple[int, ...], float] = {}
    for rows in chosen:
        for roundels in permutations(range(len(pixels)), 3):
            for T_cam_world in _three_point_poses(xy[list(roundels)], places[list(rows)]):
                assignment, distance_px = _match(camera, T_cam_world, pixels, places)
                found[assignment] = min(found.get(assignment, np.inf), distance_px)
    ranked = sorted(found, key=lambda rows: (sum(k >= 0 for k in rows), -found[rows]), reverse=True)
    if not ranked or sum(k >= 0 for k in ranked[0]) < MIN_MARKERS:
        raise CalibrationError(
            f"camera '{name}' sees {len(pixels)} stationary roundels, of which no {MIN_MARKERS} are where the points "
            "are; check the units (metres), and the lens"
        )
    best = ranked[0]
    for other in ranked[1:]:
        if sum(k >= 0 for k in other) == sum(k >= 0 for k in best) and found[other] < 2 * found[best] + 0.5:
            raise CalibrationError(
                f"camera '{name}': the points match its roundels in two ways (they are symmetric); use unequal "
                "distances, or number the roundels in the observations"
            )
    return np.array(best, np.intp)


def _three_point_poses(xy: Array, places: Array) -> Iterator[Array]:
    """T_cam_world (4, 4) under which three points (3, 3) have image plane coordinates (3, 2)."""
    _, turns, shifts = cv2.solveP3P(places, xy, np.eye(3), None, flags=cv2.SOLVEPNP_AP3P)
    for turn, shift in zip(turns, shifts, strict=True):
        T = motion_from(turn, shift)
        if np.isfinite(T).all():
            yield T


def _match(camera: Camera, T_cam_world: Array, pixels: Array, places: Array) -> tuple[tuple[int, ...], float]:
    """The nearest roundel of each point, or -1 where none is near enough, and their mean distance in pixels."""
    distances = np.linalg.norm(camera.project(transform(T_cam_world, places))[:, None] - pixels[None], axis=2)
    distances = np.where(np.isfinite(distances), distances, np.inf)
    nearest = distances.argmin(axis=1)
    least = distances[np.arange(len(places)), nearest]
    near = least < FIT_PX
    rows = np.where(near, nearest, -1)
    return tuple(rows.tolist()), float(least[near].mean()) if near.any() else np.inf


@dataclass(frozen=True, slots=True)
class _Fit:
    """A camera's pose `T` (4, 4), T_world_cam, at the minimum of chi-square over N points."""

    camera: Camera
    T: Array
    pixels: Array
    places: Array
    sigma_m: float

    def errors(self) -> tuple[Array, Array, Array]:
        """Whitened errors (N, 2), and their derivatives by the pose (N, 2, 6) and by the lens (N, 2, P)."""
        local = transform(invert(self.T), self.places)
        uv, J_point, J_pose, _ = pixel_jacobians(self.camera, local)
        J_lens = self.camera.project_with_jacobians(local)[2]
        cov = SIGMA_PX**2 * np.eye(2) + self.sigma_m**2 * J_point @ np.swapaxes(J_point, 1, 2)
        root = np.linalg.inv(np.linalg.cholesky(cov))
        return (root @ (self.pixels - uv)[:, :, None])[:, :, 0], root @ J_pose, root @ J_lens

    def chi2(self) -> float:
        """Infinite where a point is behind the camera."""
        local = transform(invert(self.T), self.places)
        return float((self.errors()[0] ** 2).sum()) if (local[:, 2] > 0).all() else np.inf

    def moved(self) -> "_Fit":
        """The pose after a step of Gauss and Newton."""
        error, J, _ = self.errors()
        step = np.linalg.lstsq(J.reshape(-1, 6), error.ravel(), rcond=None)[0]
        T = self.T.copy()
        T[:3, 3] += T[:3, :3] @ step[3:]
        T[:3, :3] = T[:3, :3] @ rotation_from_vector(step[:3])
        return _Fit(self.camera, T, self.pixels, self.places, self.sigma_m)

    def covariance(self) -> Array:
        """(6, 6) of the pose, rotation first, in the camera's own frame; larger where the points fit badly."""
        error, J, J_lens = (part.reshape(2 * len(self.places), -1) for part in self.errors())
        inverse = np.linalg.inv(J.T @ J)
        by_lens = inverse @ J.T @ J_lens * (np.array(self.camera.lens_sigma or 0.0))
        excess = max(float((error**2).sum()) / (len(error) - 6), 1.0)
        return np.asarray(excess * inverse + by_lens @ by_lens.T, float)

    def misses_m(self) -> Array:
        """(N,) distances of the points from the rays of their roundels."""
        local = transform(invert(self.T), self.places)
        return np.linalg.norm(np.cross(self.camera.rays(self.pixels), local), axis=1)


def _fit_uniquely(name: str, camera: Camera, pixels: Array, places: Array, sigma_m: float) -> _Fit:
    """The best pose.

    Raises:
        CalibrationError: another pose fits nearly as well: points in a plane that are seen from far away have two.
    """
    fits = sorted(_fit_from_all_starts(camera, pixels, places, sigma_m), key=lambda fit: fit.chi2())
    if not fits:
        raise CalibrationError(f"camera '{name}': no pose fits the points; check their names and the lens")
    best = fits[0]
    for other in fits[1:]:
        turn = rotation_angle(best.T[:3, :3].T @ other.T[:3, :3])
        if turn > 1e-3 and other.chi2() < best.chi2() + MARGIN:
            raise CalibrationError(
                f"camera '{name}': two poses fit the points, {np.degrees(turn):.0f} degrees apart; spread the points, "
                "or put some higher"
            )
    return best


def _fit_from_all_starts(camera: Camera, pixels: Array, places: Array, sigma_m: float) -> Iterator[_Fit]:
    """Fits from the poses of all points, of which those in a plane have two."""
    for T in solve_view(places, camera.normalise(pixels)):
        fit = _Fit(camera, invert(T), pixels, places, sigma_m)
        for _ in range(STEPS):
            if not np.isfinite(fit.chi2()):
                break
            fit = fit.moved()
        if np.isfinite(fit.chi2()):
            yield fit
