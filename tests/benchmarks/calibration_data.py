# SPDX-License-Identifier: BSD-3-Clause
"""The wand calibration beside a plain bundle adjustment: `python -m tests.benchmarks.calibration data`.

The plain adjustment is SciPy's least squares over poses and lenses of all cameras and over all points, with equal
weights, no priors, and no motion model; tracks are interpolated in time with the clocks of the rig from which it
starts. Recordings are those of ../shared/data.

- `waved-led`: residuals of all images, their points triangulated by either rig: root mean square of all, and without
  the outliers that plain least squares fits and ours rejects; and their mean, which MultiCamSelfCal reports.
- `arena-small`: errors of the cameras' positions. Its frames are 0.3 s apart, so few points are in two cameras at once
  and the plain adjustment has 70 of them: its residual says nothing.
- `webcams`: two corners of the board are the wand; errors of the distances between all corners, of which most were in
  neither adjustment. `--pairs N` (6) pairs of corners at least 120 mm apart, by `--seed S` (0).
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import msgspec
import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.optimize import least_squares
from scipy.sparse import coo_array

from calib.errors import CalibrationError
from calib.rig.camera import Camera, with_distortion
from calib.rig.estimation import rms
from calib.rig.rig import Rig
from calib.rig.triangulation import triangulate_points
from calib.wand.calibrate import calibrate
from calib.wand.wand_report import WandCalibration
from camera_node.foundation.arrays import Array, Index
from camera_node.geometry.body import Body
from camera_node.geometry.pose import Pose, rotation_from_vector
from camera_node.protocol.messages import Detections
from camera_node.sources.recorded_detections import detect_frames
from tests.benchmarks.calibration_recordings import (
    DATA,
    Tracks,
    board_corners,
    corner_errors,
    pixels_at,
    recording,
    sorted_track,
    tracks_of_messages,
)
from tests.calib.mishaps import repack
from tests.calib.synthetic import WAND, camera_errors
from tests.truth import true_camera

LENGTH_SIGMA_M = 2e-4
MIN_WAND_M = 0.12
GOAL = 1.03  # most of our figure over that of the plain adjustment
OUTLIER = 4.5  # robust standard deviations
PER_CAMERA = 15  # pose, log f, log fx / fy, principal point, k1, k2, p1, p2, k3


@dataclass(frozen=True, slots=True)
class Comparison:
    """A figure of our rig and of the plain one, and the number of cameras that ours places."""

    name: str
    placed: int
    ours: float
    plain: float


@dataclass(frozen=True, slots=True)
class Points:
    """Images of points: (n,) camera and point, (n, 2) pixels; (l, 2) pairs of points and (l,) their known distances,
    metres."""

    camera: Index
    point: Index
    uv: Array
    pairs: Index
    lengths: Array


def gather_points(tracks: Sequence[Tracks], gap_s: float, wand: Body | None = None) -> Points:
    """All images at the times of each frame of the camera with most frames, those of others interpolated in time; with
    the distances of a `wand`, if one is given."""
    most = max(tracks, key=lambda track: sum(len(t) for t, _ in track.values()))
    labels = sorted({label for track in tracks for label in track})
    rows, pairs, lengths, count = [], [], [], 0
    for t_s in np.unique(np.concatenate([t for t, _ in most.values()])):
        found, every = {}, pixels_at(tracks, labels, t_s, gap_s)
        for label, uv in zip(labels, np.swapaxes(every, 0, 1), strict=True):
            cameras = np.flatnonzero(np.isfinite(uv[:, 0])).tolist()
            if len(cameras) >= 2:
                found[label] = count
                rows += [(c, count, *uv[c]) for c in cameras]
                count += 1
        if wand is not None:
            for a, b in combinations(found, 2):
                pairs.append((found[a], found[b]))
                lengths.append(np.linalg.norm(wand.points[a] - wand.points[b]))
    table = np.array(rows)
    camera, point = table[:, :2].astype(np.intp).T
    return Points(camera, point, table[:, 2:], np.array(pairs, np.intp).reshape(-1, 2), np.array(lengths))


def tracks_of_result(result: WandCalibration) -> list[Tracks]:
    """The detections that a calibration labeled, at the discs' own centres, whether it rejected them or not."""
    seen, state = result.observations, result.adjusted.state
    t_s = state.true_times(seen, result.adjusted.problem.middle_s)
    table = np.column_stack([t_s, seen.uv])
    return [
        {
            label: sorted_track(table[(seen.camera == camera) & (seen.label == label)])
            for label in np.unique(seen.label).tolist()
        }
        for camera in range(len(result.names))
    ]


def adjust_plainly(rig: Rig, points: Points) -> Rig:
    """The rig adjusted to the points, with free lenses."""
    cameras = [with_distortion(camera) for camera in rig.placed().values()]
    size = len(cameras) * PER_CAMERA
    start = np.concatenate([np.zeros(size), triangulate(cameras, points).ravel()])
    n, at = len(points.uv), np.arange(len(points.uv))
    ones = [(2 * at + r, PER_CAMERA * points.camera + p) for r in range(2) for p in range(PER_CAMERA)]
    ones += [(2 * at + r, size + 3 * points.point + p) for r in range(2) for p in range(3)]
    pair = np.arange(len(points.pairs))
    ones += [(2 * n + pair, size + 3 * points.pairs[:, e] + p) for e in range(2) for p in range(3)]
    row, column = (np.concatenate(part) for part in zip(*ones, strict=True))
    pattern = coo_array((np.ones(len(row)), (row, column)), (2 * n + len(pair), len(start)))
    scale = np.concatenate(
        [np.tile([1e-2] * 8 + [10.0, 10.0] + [0.1] * 5, len(cameras)), np.ones(len(start) - size)]
    )
    found = least_squares(
        lambda x: _residuals(cameras, points, x),
        start,
        jac_sparsity=pattern,
        x_scale=scale,
        max_nfev=60,
        ftol=1e-5,
    ).x
    changed = [change(c, x) for c, x in zip(cameras, found[:size].reshape(-1, PER_CAMERA), strict=True)]
    return Rig(cameras=rig.cameras | dict(zip(rig.placed(), changed, strict=True)))


def _residuals(cameras: Sequence[Camera], points: Points, x: Array) -> Array:
    """Pixels, and lengths in standard deviations. The world is free: the trust region holds it."""
    size = len(cameras) * PER_CAMERA
    moved = [change(c, p) for c, p in zip(cameras, x[:size].reshape(-1, PER_CAMERA), strict=True)]
    there = x[size:].reshape(-1, 3)
    pixels = np.nan_to_num(project(moved, points, there) - points.uv, nan=1e3)
    ends = there[points.pairs]
    length = (np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) - points.lengths) / LENGTH_SIGMA_M
    return np.concatenate([pixels.ravel(), length]).astype(float)


def change(camera: Camera, x: Array) -> Camera:
    """The camera with changes (15,) of its pose and lens."""
    T = camera.matrix().copy()
    T[:3, 3] += T[:3, :3] @ x[3:6]
    T[:3, :3] = T[:3, :3] @ rotation_from_vector(x[:3])
    parameters = np.array(camera.parameters)
    parameters[:2] *= np.exp([x[6] + x[7] / 2, x[6] - x[7] / 2])
    parameters[2:9] += x[8:]
    return msgspec.structs.replace(camera.with_parameters(parameters), T_world_cam=Pose.from_matrix(T))


def project(cameras: Sequence[Camera], points: Points, there: Array) -> Array:
    """(n, 2) pixels of points (p, 3) in their cameras."""
    uv = np.empty_like(points.uv)
    for c, camera in enumerate(cameras):
        rows, T = points.camera == c, camera.matrix()
        uv[rows] = camera.project((there[points.point[rows]] - T[:3, 3]) @ T[:3, :3])
    return uv


def triangulate(cameras: Sequence[Camera], points: Points) -> Array:
    """(p, 3) the points at the least squares of their pixels."""
    uv = np.full((len(cameras), int(points.point.max()) + 1, 2), np.nan)
    uv[points.camera, points.point] = points.uv
    return triangulate_points(cameras, uv)


def residuals_px(rig: Rig, points: Points) -> Array:
    """(n,) distances of all images from those of their points."""
    cameras = list(rig.placed().values())
    return np.linalg.norm(project(cameras, points, triangulate(cameras, points)) - points.uv, axis=1)


def waved_led() -> list[Comparison]:
    """Residuals of all images, and of those that neither rig takes for outliers."""
    rig, messages = recording(DATA / "waved_led" / "observations.csv")
    found = calibrate(rig, Body(diameter_m=0.1), messages).rig
    points = gather_points(tracks_of_messages(found, messages), gap_s=0.0)
    both = [residuals_px(r, points) for r in (found, adjust_plainly(found, points))]
    usual = np.all([off < OUTLIER * np.median(off) / 1.1774 for off in both], axis=0)
    placed, every = len(found.placed()), [rms(off) for off in both]
    without = f"waved-led without {(~usual).sum()} outliers, px"
    return [
        Comparison("waved-led, RMS, px", placed, *every),
        Comparison(without, placed, *(rms(off[usual]) for off in both)),
        Comparison("waved-led, mean, px", placed, *(float(off.mean()) for off in both)),
    ]


def arena_small() -> Comparison:
    """Errors of the cameras' positions, from a rendered wand."""
    folder = DATA / "arena_small"
    entries = json.loads((folder / "truth.json").read_text())["cameras"]
    rig, truth = (
        Rig(cameras={n: true_camera(e, placed) for n, e in entries.items()}) for placed in (False, True)
    )
    result = calibrate(rig, WAND, detect_frames(folder / "wand", inner_ratios=(WAND.inner_ratio,)))
    points = gather_points(tracks_of_result(result), result.adjusted.problem.gap_s, WAND)
    both = (result.rig, adjust_plainly(result.rig, points))
    errors = (1e3 * rms(camera_errors(r, truth)[0]) for r in both)
    return Comparison("arena-small, camera positions, mm", len(result.names), *errors)


def webcams(a: int, b: int) -> Comparison:
    """Errors of the distances between all corners, with the corners a and b as the wand."""
    rig, every = recording(DATA / "webcams" / "corners_observations.csv")
    board = np.array(board_corners())
    length = float(np.linalg.norm(board[a] - board[b]))
    wand = Body(diameter_m=0.05, markers=((0.0, 0.0, 0.0), (length, 0.0, 0.0)))
    messages = [_only(message, (a, b)) for message in every]
    name = f"webcams, corners {a} and {b}, mm"
    try:
        found = calibrate(rig, wand, messages).rig
    except CalibrationError as error:
        Console().print(f"{name}: {error}")
        return Comparison(name, 0, np.inf, np.nan)
    plain = adjust_plainly(found, gather_points(tracks_of_messages(found, messages), 0.34, wand))
    ours, theirs = (1e3 * rms(corner_errors(r, every)) for r in (found, plain))
    return Comparison(name, len(found.placed()), ours, theirs)


def _only(message: Detections, labels: tuple[int, int]) -> Detections:
    """The message with the roundels of two labels, as markers 0 and 1."""
    roundels = message.unpack()
    rows = np.flatnonzero(np.isin(roundels.id, labels))
    chosen = type(roundels)(*(getattr(roundels, name)[rows] for name in type(roundels).__slots__))
    chosen.id[:] = (chosen.id == labels[1]).astype(chosen.id.dtype)
    return repack(message, chosen)


def run(arguments: Sequence[str]) -> None:
    """Print a row for each recording."""
    parser = argparse.ArgumentParser(prog="tests.benchmarks.calibration data")
    parser.add_argument("--pairs", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    board = np.array(board_corners())
    far = [(a, b) for a, b in combinations(range(12), 2) if np.linalg.norm(board[a] - board[b]) >= MIN_WAND_M]
    chosen = np.random.default_rng(options.seed).permutation(len(far))[: options.pairs]
    console, table = Console(), Table("recording", "cameras", "ours", "plain", "ratio", "goal")
    try:
        rows = [*waved_led(), arena_small(), *(webcams(*far[k]) for k in sorted(chosen))]
    except FileNotFoundError as missing:
        console.print(f"{missing} is absent")
        return
    for row in rows:
        ratio = row.ours / row.plain
        mark = "" if row.placed == 4 and ratio <= GOAL else " !"
        figures = (f"{row.ours:.3f}", f"{row.plain:.3f}", f"{ratio:.3f}{mark}", f"<= {GOAL}")
        table.add_row(row.name, f"{row.placed} of 4", *figures)
    console.print(table)
