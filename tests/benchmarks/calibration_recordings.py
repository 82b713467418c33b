# SPDX-License-Identifier: BSD-3-Clause
"""Recordings of ../shared/data for the calibration benchmarks, and the errors of a board's corners."""

from itertools import combinations
from pathlib import Path

import numpy as np

from calib.rig.camera import Camera
from calib.rig.rig import Rig, load_rig
from camera_node.foundation.arrays import Array
from camera_node.protocol.messages import Detections
from camera_node.sources.recorded_detections import read_observations

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
SQUARE_M = 0.054


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


def corner_errors(rig: Rig, messages: list[Detections], step_s: float = 0.17) -> Array:
    """Errors of the distances between corners that are triangulated at the same time, metres.

    Corners are triangulated at the time of one frame in each `step_s`; the other cameras' corners are interpolated
    between two frames, at their corrected times.
    """
    tracks = {name: _tracks(camera, name, messages) for name, camera in rig.placed().items()}
    times = np.unique(np.concatenate([t for track in tracks.values() for t, _ in track.values()]))
    sampled = times[np.diff(times // step_s, prepend=-1) > 0]
    board, errors = np.array(board_corners()), []
    for t_s in sampled:
        found = {
            corner: point
            for corner in range(12)
            if (point := _triangulate(rig, tracks, corner, t_s, 2 * step_s)) is not None
        }
        errors += [
            np.linalg.norm(found[a] - found[b]) - np.linalg.norm(board[a] - board[b])
            for a, b in combinations(found, 2)
        ]
    return np.array(errors)


def _tracks(camera: Camera, name: str, messages: list[Detections]):
    rows: dict[int, list[tuple[float, float, float]]] = {}
    for message in messages:
        if message.camera == name:
            seen = message.unpack()
            for corner, uv in zip(seen.id.tolist(), seen.uv, strict=True):
                rows.setdefault(corner, []).append((camera.capture_ns(message.t_ns) * 1e-9, *uv.tolist()))
    tables = {corner: np.array(sorted(table)) for corner, table in rows.items()}
    return {corner: (table[:, 0], camera.normalise(table[:, 1:])) for corner, table in tables.items()}


def _triangulate(rig: Rig, tracks, corner: int, t_s: float, gap_s: float) -> Array | None:
    centres, rays = [], []
    for name, track in tracks.items():
        if corner not in track:
            continue
        t, xy = track[corner]
        k = int(np.searchsorted(t, t_s, side="right"))
        if not 0 < k < len(t) or t[k] - t[k - 1] > gap_s:
            continue
        share = (t_s - t[k - 1]) / (t[k] - t[k - 1])
        T = rig.cameras[name].matrix()
        centres.append(T[:3, 3])
        rays.append(T[:3, :3] @ np.append((1 - share) * xy[k - 1] + share * xy[k], 1.0))
    return _intersect(np.array(centres), np.array(rays)) if len(rays) >= 2 else None


def _intersect(centres: Array, rays: Array) -> Array:
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None]
    return np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, centres))
