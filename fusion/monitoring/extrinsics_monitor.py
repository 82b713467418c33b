# SPDX-License-Identifier: BSD-3-Clause
"""A bumped camera: noticed by what it no longer agrees with, and placed anew by the robots that the others see.

While robots are tracked by two other cameras, where a camera should see their markers does not depend on it. A camera
that detects roundels as before, but hardly any of them there, was moved. Its detections are set aside. (A small move
does not take its detections out of their gates, but pulls the robots along: where residuals rise, each camera is left
out in turn, and the one without which they fall is left out until it is named.) Then

1. the shift in the image on which most pairs of expected and detected roundels agree names its detections, and
2. Gauss-Newton on the camera's pose, weighed by Cauchy, places it, and names them better; until both stay.

The other cameras, and with them the world's origin, do not move.
"""

from collections import deque
from dataclasses import dataclass, field

import msgspec
import numpy as np
from numpy.typing import NDArray

from calib.rig.camera import Camera, pixel_jacobians
from camera_node.arrays import Array
from camera_node.geometry.pose import Pose, rotation_from_vector
from fusion.model.frames import CalibratedFrame

AGREE_PX = 2.0  # between where a roundel is expected and detected, while a camera stands
STRANGE_PX, STRANGE = 0.2, 2.0  # median residual: at the least, and by the usual one
LEARN = 15  # instants in which the usual one is learnt
MEMORY_NS = 700_000_000  # of what a camera's verdict is made
MIN_EXPECTED = 12  # markers in that time
SHARE_WRONG, SHARE_RIGHT = (
    0.3,
    0.6,
)  # of the expected ones: a camera below the first was moved, above the second stands
HEAL_VIEWS = 300  # expected markers from which a pose is found
FRESH_NS = 4_000_000_000  # older ones are forgotten
TRY_NS = 300_000_000  # between attempts
SEARCH_PX = 120.0  # of a shift in the image: 8 degrees at a focal length of 840 px
BIN_PX = 6.0
GATES_PX = (12.0, 6.0, 4.0, 3.0, 3.0, 3.0)
HEALED_PX = 1.2  # RMS, under which a pose is believed
SIGMA_M, SIGMA_RAD = 0.008, 0.004  # by which it must be known, if residuals were 0.5 px


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """What a frame should show: points (3, N) in the world that project to its outlines' centres."""

    frame: CalibratedFrame
    points: Array


@dataclass(slots=True)
class _Watched:
    """One camera: (time, expected, agreeing, detected) of its last frames, and what a new pose is made of."""

    samples: deque[tuple[int, int, int, int]] = field(default_factory=deque)
    views: deque[Expected] = field(default_factory=deque)
    tried_ns: int = 0


class ExtrinsicsMonitor:
    """Which cameras stand where the rig says; `bumped` are those that do not, set aside."""

    def __init__(self) -> None:
        self.bumped: set[str] = set()
        self.held: set[str] = set()  # those whose pose a person insists on
        self._cameras: dict[str, _Watched] = {}
        self._usual_px, self._learnt, self._suspect = 0.0, 0, ""

    def is_strange(self, squared_px: Array) -> bool:
        """Whether what remains of an instant's detections (N,), px^2, is far more than usual."""
        if len(squared_px) < MIN_EXPECTED:
            return False
        median = _median_px(squared_px)
        return self._learnt >= LEARN and median > max(STRANGE_PX, STRANGE * self._usual_px)

    def learn(self, squared_px: Array) -> None:
        """Take what remains of an instant's detections as usual."""
        if len(squared_px) >= MIN_EXPECTED:
            self._learnt += 1
            self._usual_px += (_median_px(squared_px) - self._usual_px) / min(self._learnt, LEARN)

    def suspects(self, names: tuple[str, ...]) -> list[str]:
        """The cameras, the last suspect first."""
        return sorted(names, key=lambda name: name != self._suspect)

    def explains(self, name: str, rest_px2: Array, all_px2: Array) -> bool:
        """Whether without this camera little remains of the others' detections."""
        if not len(rest_px2) or np.nanmedian(rest_px2) > (np.nanmedian(all_px2) / STRANGE**2):
            return False
        self._suspect = name
        return True

    def note(self, camera: Camera, expected: Expected) -> None:
        """Take what a frame should show and what it does."""
        frame = expected.frame
        watched = self._cameras.setdefault(frame.camera, _Watched())
        uv = camera.project_world(expected.points.T)
        off = np.linalg.norm(uv[:, None] - frame.roundels.uv[None], axis=2)
        agreeing = int((off.min(1, initial=np.inf) < AGREE_PX).sum())
        watched.samples.append((frame.t_ns, len(uv), agreeing, len(frame.roundels)))
        while watched.samples[0][0] < frame.t_ns - MEMORY_NS:
            watched.samples.popleft()
        if frame.camera in self.bumped:
            watched.views.append(expected)
            while watched.views[0].frame.t_ns < frame.t_ns - FRESH_NS:
                watched.views.popleft()

    def find_bumped(self) -> str | None:
        """The camera that was moved, if one was while most of the others stand; it is set aside from now on."""
        shares = {name: share for name, w in self._cameras.items() if (share := _share(w)) is not None}
        open_ = {name: share for name, share in shares.items() if name not in self.bumped | self.held}
        standing = [name for name, share in shares.items() if share > SHARE_RIGHT and name not in self.bumped]
        wrong = [name for name, share in open_.items() if share < SHARE_WRONG]
        if len(wrong) != 1 or len(standing) < 2:
            return None
        self.bumped.add(wrong[0])
        return wrong[0]

    def heal(self, name: str, camera: Camera) -> Camera | None:
        """The camera where it stands now, or None while too little is known."""
        watched = self._cameras.get(name)
        if watched is None or not watched.views:
            return None
        views, now_ns = watched.views, watched.views[-1].frame.t_ns
        if now_ns - watched.tried_ns < TRY_NS or sum(v.points.shape[1] for v in views) < HEAL_VIEWS:
            return None
        watched.tried_ns = now_ns
        moved = place_anew(camera, list(views))
        if moved is not None:
            self.trust(name)
        else:  # it may still have been moving
            for _ in range(len(views) // 2):
                views.popleft()
        return moved

    def hold(self, name: str) -> None:
        """A person says where this camera stands: it is not doubted any more."""
        self.trust(name)
        self.held.add(name)

    def trust(self, name: str) -> None:
        """Take a camera back, and forget what was seen of it."""
        self.bumped.discard(name)
        self._cameras.pop(name, None)


def _median_px(squared_px: Array) -> float:
    """Of what remains of the detections that can be seen."""
    known = squared_px[np.isfinite(squared_px)]
    return float(np.sqrt(np.median(known))) if len(known) else np.nan


def _share(watched: _Watched) -> float | None:
    """How much of what was expected was there; None where too little was expected, or little was detected at all."""
    _, expected, agreeing, detected = np.sum(watched.samples, axis=0) if watched.samples else (0, 0, 0, 0)
    return agreeing / expected if expected >= MIN_EXPECTED and detected >= expected / 2 else None


def place_anew(camera: Camera, views: list[Expected]) -> Camera | None:
    """The camera, its pose found from markers that others see; None where they do not settle it.

    Args:
        camera: as it stood.
        views: frames in which markers at known places are expected; which detection is of which is not known.
    """
    points = np.concatenate([view.points for view in views], axis=1).T
    seen = np.repeat(np.arange(len(views)), [view.points.shape[1] for view in views])
    T, shift, rms, covariance = camera.matrix(), _shift(camera, views), np.inf, np.eye(6)
    for gate in GATES_PX:
        uv = _at(camera, T).project_world(points) + shift
        rows, measured = _nearest(views, uv, seen, gate)
        if len(rows) < len(points) / 3:
            return None
        T, rms, covariance = _fit(camera, T, points[rows], measured)
        shift = np.zeros(2)
    sigma = 0.5 * np.sqrt(np.diag(covariance))
    if rms > HEALED_PX or max(sigma[3:]) > SIGMA_M or max(sigma[:3]) > SIGMA_RAD:
        return None
    return _at(camera, T)


def _at(camera: Camera, T: Array) -> Camera:
    return msgspec.structs.replace(camera, T_world_cam=Pose.from_matrix(T))


def _shift(camera: Camera, views: list[Expected]) -> Array:
    """(2,) the shift in the image on which most pairs of expected and detected roundels agree."""
    size = int(SEARCH_PX / BIN_PX)
    votes = np.zeros((2 * size + 1, 2 * size + 1))
    shifts = []
    for view in views:
        off = view.frame.roundels.uv[None] - camera.project_world(view.points.T)[:, None]
        shifts.append(off.reshape(-1, 2))
    off = np.concatenate(shifts)
    off = off[(np.abs(off) < SEARCH_PX).all(1)]
    np.add.at(votes, tuple(np.round(off / BIN_PX).astype(int).T + size), 1)
    smooth = sum(np.roll(votes, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1))
    best = (np.array(np.unravel_index(np.argmax(smooth), votes.shape)) - size) * BIN_PX
    near = off[np.linalg.norm(off - best, axis=1) < 2 * BIN_PX]
    return np.median(near, axis=0) if len(near) else np.zeros(2)


def _nearest(views: list[Expected], uv: Array, seen: NDArray, gate: float) -> tuple[NDArray, Array]:
    """Rows of `uv` (N, 2) with a detection of their frame within `gate`, and those detections (K, 2)."""
    rows, found = [], []
    for k, view in enumerate(views):
        mine = np.flatnonzero(seen == k)
        off = np.linalg.norm(uv[mine, None] - view.frame.roundels.uv[None], axis=2)
        if off.shape[1] and len(mine):
            best = off.argmin(1)
            kept = off[np.arange(len(mine)), best] < gate
            rows.append(mine[kept])
            found.append(view.frame.roundels.uv[best[kept]])
    return np.concatenate([np.empty(0, int), *rows]), np.concatenate([np.empty((0, 2)), *found])


def _fit(camera: Camera, T: Array, points: Array, measured: Array) -> tuple[Array, float, Array]:
    """T_world_cam (4, 4) that explains centres (N, 2) of points (N, 3), RMS in pixels, covariance (6, 6) for 1 px.

    The tangent is rotation, then translation, in the camera's frame.
    """
    for _ in range(8):
        H, right, _ = _normal_equations(camera, T, points, measured)
        step = np.linalg.solve(H, right)
        T = T.copy()
        T[:3, 3] += T[:3, :3] @ step[3:]
        T[:3, :3] = T[:3, :3] @ rotation_from_vector(step[:3])
    H, _, rms = _normal_equations(camera, T, points, measured)
    return T, rms, np.asarray(np.linalg.inv(H), float)


def _normal_equations(camera: Camera, T: Array, points: Array, measured: Array) -> tuple[Array, Array, float]:
    """(6, 6) information and (6,) right side, weighed by Cauchy; and the median distance, pixels."""
    A, b = _linearise(camera, T, points, measured)
    square = np.sum(b**2, 1)
    weighed = A / (1 + square)[:, None, None]
    H = np.einsum("nai,naj->ij", weighed, A) + 1e-9 * np.eye(6)
    return H, np.einsum("nai,na->i", weighed, b), float(np.sqrt(np.median(square)))


def _linearise(camera: Camera, T: Array, points: Array, measured: Array) -> tuple[Array, Array]:
    """A (K, 2, 6) and b (K, 2) of A xi = b, the points that can be seen."""
    p = (points - T[:3, 3]) @ T[:3, :3]
    uv, _, J_pose, _ = pixel_jacobians(camera, p)
    known = np.isfinite(uv).all(1)
    return J_pose[known], (measured - uv)[known]
