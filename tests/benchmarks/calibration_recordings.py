# SPDX-License-Identifier: BSD-3-Clause
"""Recordings of ../shared/data for the calibration benchmarks: points that cameras saw over time, and the errors of a
board's corners."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np

from calib.rig.camera import Camera
from calib.rig.rig import Rig, load_rig
from calib.rig.triangulation import intersect_images
from camera_node.foundation.arrays import Array
from camera_node.protocol.messages import Detections
from camera_node.sources.recorded_detections import read_observations

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
SQUARE_M = 0.054

# Of one camera, by marker: true times (n,), ascending, and pixels (n, 2).
Tracks = Mapping[int, tuple[Array, Array]]


def board_corners() -> tuple[tuple[float, float, float], ...]:
    """The twelve inner corners, metres."""
    return tuple(((k % 3 + 1) * SQUARE_M, (k // 3 + 1) * SQUARE_M, 0.0) for k in range(12))


def recording(path: Path) -> tuple[Rig, list[Detections]]:
    """Lenses and observations.

    Raises:
        FileNotFoundError: the recording is not beside the checkout.
    """
    if not path.exists():
        raise FileNotFoundError(path)
    rig = load_rig(path.parent / "cameras.yaml")
    return rig, read_observations(path, {n: (c.width, c.height) for n, c in rig.cameras.items()})


def tracks_of_messages(rig: Rig, messages: Sequence[Detections]) -> list[Tracks]:
    """The numbered detections of the placed cameras."""
    return [_track(camera, name, messages) for name, camera in rig.placed().items()]


def _track(camera: Camera, name: str, messages: Sequence[Detections]) -> Tracks:
    rows: dict[int, list[tuple[float, ...]]] = {}
    for message in messages:
        if message.camera == name:
            seen = message.unpack()
            t_s = camera.capture_ns(message.t_ns) * 1e-9
            for label, uv in zip(seen.id.tolist(), seen.uv.tolist(), strict=True):
                rows.setdefault(label, []).append((t_s, *uv))
    return {label: sorted_track(np.array(table)) for label, table in rows.items()}


def sorted_track(table: Array) -> tuple[Array, Array]:
    """Times and pixels of rows (n, 3) in the order of time."""
    table = table[np.argsort(table[:, 0], kind="stable")]
    return table[:, 0], table[:, 1:]


def pixels_at(tracks: Sequence[Tracks], labels: Sequence[int], t_s: float, gap_s: float) -> Array:
    """(C, L, 2) pixels of markers in C cameras at a time, interpolated over gaps of at most `gap_s`; else NaN."""
    uv = np.full((len(tracks), len(labels), 2), np.nan)
    for camera, track in enumerate(tracks):
        for column, label in enumerate(labels):
            if label in track:
                uv[camera, column] = _pixel_at(*track[label], t_s, gap_s)
    return uv


def _pixel_at(t: Array, uv: Array, t_s: float, gap_s: float) -> Array:
    k = int(np.searchsorted(t, t_s))
    if k < len(t) and t[k] == t_s:
        return uv[k]
    if not 0 < k < len(t) or t[k] - t[k - 1] > gap_s:
        return np.full(2, np.nan)
    share = (t_s - t[k - 1]) / (t[k] - t[k - 1])
    return (1 - share) * uv[k - 1] + share * uv[k]


def corner_errors(rig: Rig, messages: Sequence[Detections], step_s: float = 0.17) -> Array:
    """Errors of the distances between corners that are triangulated at the same time, metres.

    Corners are triangulated at the time of one frame in each `step_s`; the other cameras' corners are interpolated
    between two frames, at their corrected times.
    """
    tracks, cameras = tracks_of_messages(rig, messages), list(rig.placed().values())
    times = np.unique(np.concatenate([t for track in tracks for t, _ in track.values()]))
    sampled = times[np.diff(times // step_s, prepend=-1) > 0]
    board, poses, errors = np.array(board_corners()), np.array([c.matrix() for c in cameras]), []
    for t_s in sampled:
        uv = pixels_at(tracks, range(len(board)), t_s, 2 * step_s)
        xy = np.array([camera.normalise(pixels) for camera, pixels in zip(cameras, uv, strict=True)])
        found = intersect_images(xy[:, None], poses, rounds=1)[0][0]
        errors += [
            np.linalg.norm(found[a] - found[b]) - np.linalg.norm(board[a] - board[b])
            for a, b in combinations(np.flatnonzero(np.isfinite(found[:, 0])), 2)
        ]
    return np.array(errors)
