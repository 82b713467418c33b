# SPDX-License-Identifier: BSD-3-Clause
"""A synthetic arena: a ring of cameras, a wand on a smooth path, and the detections of an ideal detector."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from scipy.stats import chi2

from calib.rig.camera import Camera
from calib.rig.rig import Rig
from calib.wand.quality.agreement import CameraPoses, compare_calibrations
from calib.wand.wand_report import WandCalibration
from camera_node.detection.roundels import Roundels
from camera_node.foundation.arrays import Array, Mask
from camera_node.geometry.body import Body, thickness_of
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import Pose, invert, look_at, rotation_from_vector, vector_from_rotation
from camera_node.protocol.messages import Detections

WAND = Body(diameter_m=0.12, markers=((0.0, 0.0, 0.0), (0.2, 0.0, 0.0), (0.5, 0.0, 0.0)))
STICK = Body(diameter_m=0.05, markers=((0.0, 0.0, 0.0), (0.5, 0.0, 0.0)))
PERIOD_NS = 100_000_000
RIM = 12  # points of a disc's rim, which give its outline to 1e-9 px
# Standard deviations of lens errors: relative focal length, principal point in pixels, k1.
EXACT, CAREFUL, OLD, SHEET = (0.0, 0.0, 0.0), (6e-4, 0.5, 5e-4), (4e-3, 2.0, 5e-3), (0.02, 10.0, 0.03)


@dataclass(frozen=True)
class Arena:
    """The true rig, and a wand that moves in front of it."""

    truth: Rig
    wand: Body = WAND
    speed: float = 1.0

    @property
    def intrinsics(self) -> Rig:
        """The rig before a wand calibration: without poses."""
        bare = {n: msgspec.structs.replace(c, T_world_cam=None) for n, c in self.truth.cameras.items()}
        return Rig(cameras=bare)

    def wand_pose(self, t_s: float) -> Array:
        """Return T_world_wand (4, 4): a Lissajous path of about a metre, with rotation about all axes."""
        w = self.speed * t_s
        T = np.eye(4)
        T[:3, :3] = rotation_from_vector([0.7 * np.sin(0.9 * w), 0.6 * np.cos(1.1 * w), 0.8 * w])
        T[:3, 3] = [0.9 * np.sin(0.7 * w), 0.9 * np.cos(0.53 * w), 1.0 + 0.5 * np.sin(0.43 * w + 1)]
        return T

    def see(self, name: str, times_ns: list[int], sized: bool = True) -> tuple[Array, Array, Array, Mask]:
        """Project the markers into a camera at n times; both sides of the wand are visible.

        Returns:
            uv: (n, M, 2) centres of the ellipses if `sized`, else of the discs.
            axes, angle: (n, M, 2) full axes and (n, M) angles of the ellipses.
            visible: (n, M) whether the marker is inside of the image and large enough.
        """
        camera, count = self.truth.cameras[name], len(self.wand.points)
        T = invert(camera.matrix()) @ np.array([self.wand_pose(t_ns * 1e-9) for t_ns in times_ns])
        points = (self.wand.points @ T[:, :3, :3].mT + T[:, None, :3, 3]).reshape(-1, 3)
        normals = np.repeat(T[:, :3, 2], count, axis=0)
        side = -np.sign(np.einsum("ni,ni->n", normals, points))
        points = points + thickness_of(self.wand) / 2 * side[:, None] * normals
        uv, axes, angles = outlines(camera, points, normals, self.wand.diameter_m / 2)
        uv = uv if sized else camera.project(points)
        inside = ((uv > 15) & (uv < [camera.width - 15, camera.height - 15])).all(axis=1)
        shape = (len(times_ns), count)
        return (
            uv.reshape(*shape, 2),
            axes.reshape(*shape, 2),
            angles.reshape(shape),
            (inside & (axes[:, 1] > 5)).reshape(shape),
        )


def outlines(camera: Lens, points: Array, normals: Array, radius: float) -> tuple[Array, Array, Array]:
    """Return ellipses of discs: centres (n, 2), full axes (n, 2) and angles (n,), raw pixels.

    They are fitted to the images of points of the rims, as a detector fits them: independent of the models under test.
    NaN where a rim is not in front of the camera.
    """
    turn = 2 * np.pi * np.arange(RIM) / RIM
    beside = np.where(np.abs(normals[:, :1]) < 0.7, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    first = np.cross(normals, beside)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    around = np.stack([np.cos(turn), np.sin(turn)])
    rim = np.einsum("kni,km->nmi", np.stack([first, np.cross(normals, first)]), radius * around)
    uv = camera.project((points[:, None] + rim).reshape(-1, 3)).reshape(-1, RIM, 2)
    seen = np.isfinite(uv).all(axis=(1, 2))
    centre, axes, angle = np.full((len(uv), 2), np.nan), np.full((len(uv), 2), np.nan), np.zeros(len(uv))
    centre[seen], shape = fit_ellipses(uv[seen])
    squares, along = np.linalg.eigh(shape)
    major = along[:, :, 1]
    angle[seen] = np.arctan(major[:, 1] / np.where(major[:, 0] == 0, 1e-12, major[:, 0]))
    axes[seen] = 2 * np.sqrt(np.maximum(squares[:, ::-1], 0))
    return centre, axes, angle


def fit_ellipses(curves: Array) -> tuple[Array, Array]:
    """Fit ellipses to closed curves (n, m, 2): centres (n, 2) and shapes (n, 2, 2), of which a circle of radius r has
    r^2 I; by algebraic least squares where the curves are nearly unit circles."""
    middle = curves.mean(axis=1)
    L = np.linalg.cholesky(
        2 * np.einsum("nmi,nmj->nij", off := curves - middle[:, None], off) / curves.shape[1]
    )
    x, y = np.moveaxis(np.einsum("nij,nmj->nmi", np.linalg.inv(L), off), 2, 0)
    rows = np.stack([x * x, x * y, y * y, x, y], axis=2)
    a, b, c, d, e = np.linalg.solve(rows.mT @ rows, rows.sum(axis=1)[:, :, None])[:, :, 0].T
    form = np.stack([a, b / 2, b / 2, c], axis=1).reshape(-1, 2, 2)
    at = -np.linalg.solve(form, np.stack([d, e], axis=1)[:, :, None] / 2)
    level = 1 + (at.mT @ form @ at)
    return middle + (L @ at)[:, :, 0], L @ np.linalg.inv(form / level) @ L.mT


def ring(cameras: int = 4, **options) -> Arena:
    """Build an arena: cameras with distorted lenses on a ring of 2.6 m radius, 2.4 m high, that look at its middle."""
    rng = np.random.default_rng(5)
    entries = {}
    for k in range(cameras):
        turn = 2 * np.pi * k / cameras + 0.2 * rng.uniform(-1, 1)
        place = np.array([2.6 * np.cos(turn), 2.6 * np.sin(turn), 2.4 + 0.3 * rng.uniform(-1, 1)])
        entries[f"cam{k}"] = Camera(
            width=800,
            height=600,
            fx=520.0 + 10 * k,
            fy=522.0 + 10 * k,
            cx=402.0,
            cy=297.0,
            distortion=(-0.1, 0.03, 0.0002, -0.0001, 0.0),
            T_world_cam=Pose.from_matrix(look_at(place, [0.0, 0.0, 0.8])),
        )
    return Arena(Rig(cameras=entries), **options)


@dataclass(frozen=True, kw_only=True)
class DetectorOptions:
    """Options of `record`: the noise of centres, the share of gross errors, of missing markers, and the number of false
    roundels per frame; with marker numbers if `numbered`, with axes if `sized`."""

    sigma_px: float = 0.0
    seed: int = 0
    free_running: bool = True
    numbered: bool = False
    sized: bool = True
    outliers: float = 0.0
    clutter: int = 0
    missing: float = 0.0
    period_ns: int = PERIOD_NS


def record(arena: Arena, seconds: float = 10.0, **options: Any) -> list[Detections]:
    """Record the wand with all cameras; see `DetectorOptions`."""
    chosen = DetectorOptions(**options)
    rng, period_ns = np.random.default_rng(chosen.seed), chosen.period_ns
    messages = []
    for k, (name, camera) in enumerate(arena.truth.cameras.items()):
        phase = k * period_ns // (3 * len(arena.truth.cameras)) if chosen.free_running else 0
        header = {"camera": name, "width": camera.width, "height": camera.height}
        times = [seq * period_ns + phase for seq in range(int(seconds * 1e9 / period_ns))]
        for seq, seen in enumerate(zip(*arena.see(name, times, chosen.sized), strict=True)):
            roundels = _detect(*seen, chosen, rng)
            messages.append(Detections.pack(roundels, seq=seq, t_ns=times[seq], **header))
    return messages


def see_points(
    name: str, camera: Camera, uv: Array, sigma_px: float, shown: Mask | None = None, *, seq: int, t_ns: int
) -> Detections:
    """The frame of a camera with those of the pixels (M, 2) that lie in its image, numbered by their rows; of the
    `shown` ones (M,) if these are given."""
    seen = np.flatnonzero(camera.sees(uv) if shown is None else shown & camera.sees(uv))
    roundels = Roundels.from_points(uv[seen], sigma_px, seen.astype(np.int32))
    header = {"camera": name, "width": camera.width, "height": camera.height}
    return Detections.pack(roundels, seq=seq, t_ns=t_ns, **header)


def _detect(
    uv: Array, axes: Array, angles: Array, seen: Mask, options: DetectorOptions, rng: np.random.Generator
) -> Roundels:
    """The detections in one frame of markers (M,), as `see` returns them."""
    seen = seen & (rng.random(len(uv)) >= options.missing)
    rows = rng.permutation(np.flatnonzero(seen))
    uv = uv[rows] + options.sigma_px * rng.standard_normal((len(rows), 2))
    gross = rng.random(len(rows)) < options.outliers
    uv[gross] += rng.uniform(-60, 60, (int(gross.sum()), 2))
    numbers = rows.astype(np.int32) if options.numbered else None
    roundels = Roundels.from_points(uv, max(options.sigma_px, 0.02), numbers)
    if options.sized:
        roundels = with_sizes(roundels, axes[rows], angles[rows])
    return _add_clutter(roundels, options.clutter, rng) if options.clutter else roundels


def with_sizes(roundels: Roundels, axes: Array, angles: Array) -> Roundels:
    """Return the roundels with full axes (n, 2), largest first, and angles (n,)."""
    one = np.ones(len(roundels))
    return Roundels(
        roundels.uv, roundels.cov, axes, angles, 0.6 * one, 100 * one, roundels.id, roundels.track
    )


def _add_clutter(roundels: Roundels, count: int, rng: np.random.Generator) -> Roundels:
    false = Roundels.from_points(rng.uniform([20, 20], [780, 580], (count, 2)), 0.1)
    major = rng.uniform(10, 40, count)
    false = with_sizes(false, np.column_stack([major, 0.7 * major]), rng.uniform(-1.5, 1.5, count))
    return Roundels(*(np.concatenate([getattr(roundels, n), getattr(false, n)]) for n in Roundels.__slots__))


def roughly(rig: Rig, off: tuple[float, float, float], with_sigma: bool = False, seed: int = 0) -> Rig:
    """Return the rig with random lens errors of the standard deviations `off`: relative focal length, principal point
    in pixels, and k1. The lenses state these if `with_sigma`, else no standard deviations."""
    rng, cameras, (focal, centre_px, k1) = np.random.default_rng(seed), {}, off
    for name, camera in rig.cameras.items():
        change = rng.standard_normal(4) * [focal, centre_px, centre_px, k1]
        parameters = np.array(camera.parameters)
        parameters[:2] *= np.exp(change[0])
        parameters[2:5] += change[1:]
        sigma = (focal * camera.fx, focal * camera.fy, centre_px, centre_px, k1) if with_sigma else None
        cameras[name] = msgspec.structs.replace(camera.with_parameters(parameters), lens_sigma=sigma)
    return Rig(cameras=cameras)


def errors(found: Rig, truth: Rig) -> tuple[float, float]:
    """Return the largest position error, m, and orientation error, rad, after the best rigid motion of the world."""
    shift, turn = camera_errors(found, truth)
    return float(shift.max()), float(turn.max())


def assert_near(found: Rig, truth: Rig, metres: float, radians: float) -> None:
    """Assert that no camera's position or orientation error exceeds a limit."""
    shift, turn = errors(found, truth)
    assert shift < metres
    assert turn < radians


def camera_errors(found: Rig, truth: Rig) -> tuple[Array, Array]:
    """Return position errors, m, and orientation errors, rad, by camera, after the best rigid motion of the world."""
    names = list(found.placed())
    A = np.array([found.cameras[n].matrix() for n in names])
    B = np.array([truth.cameras[n].matrix() for n in names])
    a, b = A[:, :3, 3], B[:, :3, 3]
    cross = sum(y[:3, :3] @ x[:3, :3].T for x, y in zip(A, B, strict=True))
    U, _, Vt = np.linalg.svd(cross + (b - b.mean(0)).T @ (a - a.mean(0)))
    R = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    shift = np.asarray(np.linalg.norm((a - a.mean(0)) @ R.T - (b - b.mean(0)), axis=1), float)
    turns = vector_from_rotation(B[:, :3, :3].mT @ R @ A[:, :3, :3])
    return np.asarray(shift, float), np.linalg.norm(turns, axis=1)


def joint_error(result: WandCalibration, truth: Rig) -> tuple[float, int]:
    """Return the squared Mahalanobis error of all poses, and its degrees of freedom, without the gauge: the world
    frame, and the scale if an exact distance fixes it."""
    there = np.array([truth.cameras[n].matrix() for n in result.names])
    poses = np.array([result.rig.cameras[n].matrix() for n in result.names])
    metric = result.adjusted.problem.fixed_distance is None
    agreement = compare_calibrations(
        CameraPoses(result.names, poses, result.covariance, metric=metric),
        CameraPoses(result.names, there, np.zeros_like(result.covariance)),
    )
    return agreement.chi2, agreement.degrees


def assert_honest(results: Iterable[tuple[WandCalibration, Rig]], exactly: bool = False) -> None:
    """Assert that the squared Mahalanobis errors of all poses, summed over calibrations with their true rigs, are below
    the 99.9 % quantile of chi-square; with `exactly` also above its 0.1 % quantile."""
    squared, degrees = np.sum([joint_error(*pair) for pair in results], axis=0)
    low, high = chi2.ppf([0.001, 0.999], degrees)
    assert squared < high
    assert squared > low or not exactly


def clock_errors_ms(result: WandCalibration, truth: Rig) -> Array:
    """(C,) errors of the time offsets, ms, less their mean: an offset that all clocks share is not observable."""
    off = result.time_offset_ms - [truth.cameras[name].time_offset_ms for name in result.names]
    return off - off.mean()


def camera_distances(rig: Rig, names: Iterable[str]) -> Array:
    """(C, C) distances between cameras, metres."""
    places = np.array([rig.cameras[name].matrix()[:3, 3] for name in names])
    return np.linalg.norm(places[:, None] - places, axis=2)


def random_covariance(cameras: int, rng: np.random.Generator) -> Array:
    """Return a (6C, 6C) covariance of poses with common and independent errors of 0.1 to 1 mm and mrad."""
    A = rng.standard_normal((6 * cameras, 6 * cameras)) / np.sqrt(6 * cameras)
    return (A @ A.T + 0.05 * np.eye(6 * cameras)) * 0.5e-6


def disturb(cameras: Array, off: Array, rng: np.random.Generator) -> Array:
    """Return cameras (C, 4, 4) rotated and shifted by `off` (6C,) in their own frames, in a random world frame."""
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = rotation_from_vector(rng.uniform(-2, 2, 3)), rng.uniform(-3, 3, 3)
    out = []
    for T, xi in zip(cameras, off.reshape(-1, 6), strict=True):
        D = np.eye(4)
        D[:3, :3], D[:3, 3] = rotation_from_vector(xi[:3]), xi[3:]
        out.append(world @ T @ D)
    return np.array(out)
