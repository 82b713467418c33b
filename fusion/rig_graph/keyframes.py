# SPDX-License-Identifier: BSD-3-Clause
"""Keyframes: moments that the rig graph keeps, and which detection shows which marker then.

Cameras may have other rates than the frame sets: a keyframe has of each camera the frame that is nearest to it.

A camera at fault shows its markers elsewhere than its calibration predicts, so detections are assigned again, camera by
camera: the image shift on which most pairs of expected and detected roundels agree gives first correspondences;
Gauss-Newton on the pose of the camera, with Cauchy weights, alternates with new correspondences in smaller gates. That
pose is where the search of a hypothesis begins.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from scipy.special import chdtri

from calib.rig.camera import FOCAL_STABILITY, Camera
from calib.rig.camera_errors import ERRORS
from camera_node.foundation.arrays import Array, Index, Mask
from camera_node.geometry.pose import rotation_from_vector, vector_from_rotation
from fusion.model.expected_views import GATES_PX, ExpectedViews, match_moved
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.model.nearest import mutual_nearest
from fusion.model.observations import (
    CameraArray,
    DetectionTable,
    Exposures,
    MarkerTable,
    MatchedObservations,
    count_checked,
)
from fusion.model.states import Snapshot, States
from fusion.model.undistortion import UV
from fusion.rig_graph.hypotheses import CAUSES, FREE_SIGMA, INTERVAL_NS, RIVAL, Window

HALF_NS = 100_000_000  # before and after a keyframe, for the velocities of its robots
# Variance of a mean velocity over that of its difference from the mean in half the time, by white acceleration: the
# density times HALF / 6, and times HALF / 24.
WIDER = 4.0
MAX_ROBOTS = 4  # of a keyframe; the next one has others
FOUND = 0.8  # of all pairs that may be within the last gate: detections need no other assignment
N_MEAN, N_PREDICTED = 3, 15  # moments of a mean motion, and those that show how well it predicts
MIN_SEEN = 4  # detections of a robot in a keyframe: 8 equations of its pose, 6
NEGLIGIBLE = 1e-6  # share of free errors, that keeps covariances of exact cameras regular
OFFSET_SIGMA_S = 5e-4  # of a calibrated clock offset, beside what the stamps claim


@dataclass(frozen=True, slots=True, eq=False)
class FrameView:
    """A frame, and the markers that it should show by the calibration."""

    frame: CalibratedFrame
    expected: ExpectedViews


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A moment with K of the robots that were tracked all around it.

    Attributes:
        views: of all cameras, also of those at fault.
        robots: (K,) rows of the robots.
        states: of these, with mean velocities.
        noise, change: (K, 2) variances of these, angular and linear: by the errors of the poses, and by accelerations
            that change around the keyframe (an estimate, which may be negative).
    """

    t_ns: int
    views: tuple[FrameView, ...]
    robots: Index
    states: States
    noise: Array
    change: Array


@dataclass(frozen=True, slots=True, eq=False)
class Moments:
    """Frame sets one after the other, with the robots after the update by each."""

    frame_sets: tuple[FrameSet, ...]
    snapshots: tuple[Snapshot, ...]

    def keyframe(
        self, k: int, known: int, mean: tuple[int, int], scene: tuple[CameraArray, MarkerTable]
    ) -> Keyframe | None:
        """Frame set k with the robots of moment `known`, moved on by their mean motion between two moments; None
        without robots."""
        frame_set, first, last = self.frame_sets[k], self.snapshots[mean[0]], self.snapshots[mean[1]]
        robots = np.flatnonzero(first.tracked & last.tracked & self.snapshots[known].tracked)[:MAX_ROBOTS]
        if not len(robots):
            return None
        velocities, noise = _mean_motion(first, last, robots)
        states = _predicted(self.snapshots[known].states.select(robots), velocities, self._seconds(known, k))
        every = self.snapshots[known].states.with_rows(robots, states)
        rows = np.flatnonzero(np.isin(scene[1].robot, robots))
        views = tuple(_view(scene, frame, frame_set.t_ns, every, rows) for frame in frame_set.frames)
        return Keyframe(frame_set.t_ns, views, robots, states, noise, 0 * noise)

    def prediction_sigma(self, k: int, robots: Index) -> Array:
        """(K, 2) of predictions from moment k to the next one, rad and m: RMS of those before, and of the poses."""
        errors = []
        for n in range(max(N_MEAN, k - N_PREDICTED), k):
            velocities, _ = _mean_motion(self.snapshots[n - N_MEAN], self.snapshots[n], robots)
            states = self.snapshots[n].states.select(robots)
            after = self.snapshots[n + 1].states.select(robots)
            errors.append(_predicted(states, velocities, self._seconds(n, n + 1)).minus(after)[:, :6])
        P = np.diagonal(self.snapshots[k].states.P[robots], axis1=1, axis2=2)[:, :6]
        return np.sqrt((np.mean(np.square(errors), axis=0) + P).reshape(-1, 2, 3).mean(2))

    def _seconds(self, k: int, n: int) -> float:
        return (self.frame_sets[n].t_ns - self.frame_sets[k].t_ns) * 1e-9


class Keyframes:
    """The last keyframes.

    Args:
        cameras: cameras of the rig.
        markers: of all robots.
        most: keyframes that are kept.
    """

    def __init__(self, cameras: CameraArray, markers: MarkerTable, most: int) -> None:
        self._cameras, self._markers = cameras, markers
        self.kept: deque[Keyframe] = deque(maxlen=most)
        self._history: deque[Snapshot] = deque()
        self._recent: deque[FrameSet] = deque()
        self._pending: deque[int] = deque()  # times of the next keyframes
        self._turn = 0

    def clear(self) -> None:
        """Forget all keyframes: cameras or robots are others."""
        for queue in (self.kept, self._pending, self._recent, self._history):
            queue.clear()

    def add(self, frame_set: FrameSet, now: Snapshot) -> bool:
        """Add a frame set and the robots after its update; whether there is a new keyframe, `HALF_NS` old."""
        self._history.append(now)
        self._recent.append(frame_set)
        for queue in (self._history, self._recent):
            while queue[0].t_ns < now.t_ns - 4 * HALF_NS:
                queue.popleft()
        if not self._pending or frame_set.t_ns >= self._pending[-1] + INTERVAL_NS:
            self._pending.append(frame_set.t_ns)
        if self._pending[0] > now.t_ns - HALF_NS:
            return False
        keyframe = self._keyframe(self._pending.popleft())
        if keyframe is not None:
            self.kept.append(keyframe)
        return keyframe is not None

    def retime(self, name: str, offset_s: Callable[[int], float]) -> None:
        """Correct the stamps of a camera by an offset, seconds at a time in ns."""

        def retimed(frame: CalibratedFrame) -> CalibratedFrame:
            shift_ns = round(1e9 * offset_s(frame.t_ns)) if frame.camera == name else 0
            return replace(frame, t_ns=frame.t_ns + shift_ns) if shift_ns else frame

        for k, keyframe in enumerate(self.kept):
            views = tuple(replace(view, frame=retimed(view.frame)) for view in keyframe.views)
            self.kept[k] = replace(keyframe, views=views)
        for k, recent in enumerate(self._recent):
            self._recent[k] = replace(recent, frames=tuple(map(retimed, recent.frames)))

    def _frames_at(self, t_ns: int) -> list[CalibratedFrame]:
        """Of each camera the frame that is nearest to a time, within half the interval between keyframes."""
        frames = [f for frame_set in self._recent for f in frame_set.frames]
        near = [f for f in frames if abs(f.t_ns - t_ns) <= INTERVAL_NS / 2]
        near.sort(key=lambda f: (f.camera, abs(f.t_ns - t_ns)))
        return [next(of_camera) for _, of_camera in groupby(near, lambda f: f.camera)]

    def _keyframe(self, t_ns: int) -> Keyframe | None:
        """The robots of a moment with mean velocities around it, which stamps of one frame do not change."""
        half = HALF_NS // 2
        first, early, now, late, last = (
            min(self._history, key=lambda s: abs(s.t_ns - at))
            for at in (t_ns - HALF_NS, t_ns - half, t_ns, t_ns + half, t_ns + HALF_NS)
        )
        known = np.flatnonzero(np.all([s.tracked for s in (first, early, now, late, last)], axis=0))
        if now.t_ns != t_ns or late.t_ns - early.t_ns < half or not len(known):
            return None
        self._turn += MAX_ROBOTS
        robots = np.sort(np.roll(known, -self._turn % len(known))[:MAX_ROBOTS])
        mean, noise = _mean_motion(first, last, robots)
        inner, more = _mean_motion(early, late, robots)
        states = replace(now.states.select(robots), omega=mean[0], v=mean[1])
        change = np.mean((inner - mean) ** 2, axis=2).T - noise - more
        rows = np.flatnonzero(np.isin(self._markers.robot, robots))
        scene = self._cameras, self._markers
        views = tuple(_view(scene, frame, t_ns, now.states, rows) for frame in self._frames_at(t_ns))
        return Keyframe(t_ns, views, robots, states, noise, WIDER * change)


def _view(
    scene: tuple[CameraArray, MarkerTable], frame: CalibratedFrame, t_ns: int, states: States, rows: Index
) -> FrameView:
    (cameras, markers), tau = scene, (frame.t_ns - t_ns) * 1e-9
    expected = ExpectedViews.of(cameras, frame.camera, states, tau, (markers, rows), frame.readout_s)
    return FrameView(frame, expected)


def _predicted(states: States, velocities: Array, dt: float) -> States:
    """Robots after a time with these angular and linear velocities (2, K, 3)."""
    omega, v = velocities
    return replace(
        states, R=rotation_from_vector(omega * dt) @ states.R, p=states.p + v * dt, omega=omega, v=v
    )


def _mean_motion(first: Snapshot, last: Snapshot, robots: Index) -> tuple[Array, Array]:
    """(2, K, 3) mean angular and linear velocities of robots between two times, and (K, 2) their variances."""
    a, b, seconds = first.states.select(robots), last.states.select(robots), (last.t_ns - first.t_ns) * 1e-9
    moved = np.stack([vector_from_rotation(b.R @ a.R.transpose(0, 2, 1)), b.p - a.p])
    variance = np.diagonal(a.P + b.P, axis1=1, axis2=2)[:, :6].reshape(-1, 2, 3).mean(2)
    return moved / seconds, variance / seconds**2


def window_of(
    keyframes: Sequence[Keyframe], cameras: CameraArray, markers: MarkerTable, may_have_moved: bool = True
) -> tuple[Window, Array]:
    """The problem of some keyframes, and for each camera the errors (C, 8) that explain its images alone.

    Args:
        keyframes: at least one.
        cameras: C cameras of the rig.
        markers: of all robots.
        may_have_moved: whether cameras are searched for other poses by which they show more markers.
    """
    starts = np.zeros((len(cameras.names), ERRORS))
    found: list[list[tuple[CalibratedFrame, Index, Index]]] = [[] for _ in keyframes]
    for k, name in enumerate(cameras.names):
        views = _views(keyframes, name)
        T, matches = _match(cameras[name], [view for _, view in views], may_have_moved)
        inverse = np.linalg.inv(cameras[name].matrix()) @ T
        starts[k, :3], starts[k, 3:6] = vector_from_rotation(inverse[None, :3, :3])[0], inverse[:3, 3]
        for (number, view), (rows, detections) in zip(views, matches, strict=True):
            found[number].append((view.frame, view.expected.rows[rows], detections))
    return _assemble(keyframes, found, cameras, markers), starts


def _views(keyframes: Sequence[Keyframe], name: str) -> list[tuple[int, FrameView]]:
    """The views of a camera, each with the number of its keyframe."""
    return [(k, v) for k, keyframe in enumerate(keyframes) for v in keyframe.views if v.frame.camera == name]


def _match(
    camera: Camera, views: Sequence[FrameView], may_have_moved: bool
) -> tuple[Array, list[tuple[Index, Index]]]:
    """T_world_cam (4, 4) that explains the images, and rows of expected and of detected roundels by view.

    Views that show their markers where the calibration expects them need no other pose: a camera that was moved in the
    meantime has some of both kinds.
    """
    expected, detected = [view.expected for view in views], [view.frame.columns[UV].T for view in views]
    matches = [mutual_nearest(e.uv, uv, GATES_PX[-1]) for e, uv in zip(expected, detected, strict=True)]
    possible = [min(len(e.rows), len(uv)) for e, uv in zip(expected, detected, strict=True)]
    others = [k for k, most in enumerate(possible) if len(matches[k][0]) < FOUND * most]
    if not may_have_moved or sum(len(expected[k].rows) for k in others) < ERRORS:
        return camera.matrix(), matches
    T, found = match_moved(camera, [expected[k] for k in others], [detected[k] for k in others])
    for k, match in zip(others, found, strict=True):
        matches[k] = match if len(match[0]) >= len(matches[k][0]) else matches[k]
    return T, matches


def _assemble(
    keyframes: Sequence[Keyframe],
    found: Sequence[Sequence[tuple[CalibratedFrame, Index, Index]]],
    cameras: CameraArray,
    markers: MarkerTable,
) -> Window:
    """The problem of matched detections: of each keyframe its frames, with rows of markers and of detections."""
    tables, discs, n_frames, n_bodies = [], [], 0, 0
    for keyframe, matched in zip(keyframes, found, strict=True):
        frames = FrameSet(keyframe.t_ns, tuple(frame for frame, _, _ in matched))
        table = DetectionTable.of(frames, cameras)
        first = np.cumsum([0, *(frame.columns.shape[1] for frame in frames.frames)])
        rows = np.concatenate(
            [np.empty(0, np.intp), *(at + d for at, (_, _, d) in zip(first, matched, strict=False))]
        )
        marker = np.concatenate([np.empty(0, np.intp), *(m for _, m, _ in matched)])
        rows, marker = rows.astype(np.intp), marker.astype(np.intp)
        known = np.isfinite(table.xy[0, rows]) & _are_determined(markers.robot[marker], table.camera[rows])
        table, marker = table.select(rows[known]), marker[known]
        disc = markers.discs(marker, table.frame + n_frames)
        body = n_bodies + np.searchsorted(keyframe.robots, disc.body)
        tables.append(replace(table, frame=table.frame + n_frames))
        discs.append(replace(disc, body=body, delay=table.delay))
        n_frames, n_bodies = n_frames + len(frames.frames), n_bodies + len(keyframe.robots)
    exposures = Exposures(
        *(np.concatenate([getattr(t.exposures, c) for t in tables]) for c in Exposures.__slots__)
    )
    seen = replace(tables[0].joined(*tables[1:]), exposures=exposures)
    observations = MatchedObservations.of_discs(seen, discs[0].joined(*discs[1:]))
    robots = np.concatenate([keyframe.robots for keyframe in keyframes])
    centre = np.array([[cameras[name].cx, cameras[name].cy] for name in cameras.names])
    by_focal = np.linalg.solve(seen.scale.transpose(2, 0, 1), (seen.uv - centre[seen.camera].T).T[:, :, None])
    states = keyframes[0].states.joined(*(keyframe.states for keyframe in keyframes[1:]))
    sigma = velocity_sigma(keyframes, robots)
    single = np.bincount(markers.robot)[robots] == 1
    of_window = np.flatnonzero(np.isin(markers.robot, robots))
    return Window(
        names=cameras.names,
        T=np.array([cameras[name].matrix() for name in cameras.names]),
        prior=cameras.covariance,
        since=_since(cameras, exposures),
        states=states,
        velocity_sigma=sigma,
        moving=is_significant(states.omega, sigma[:, 0]) | is_significant(states.v, sigma[:, 1]),
        single=single,
        robot=robots,
        markers=of_window,
        owner=markers.robot[of_window],
        observations=observations,
        by_focal=np.ascontiguousarray(by_focal[:, :, 0].T),
        keyframe=np.repeat(np.arange(len(keyframes)), [len(keyframe.robots) for keyframe in keyframes]),
    )


def velocity_sigma(keyframes: Sequence[Keyframe], robots: Index) -> Array:
    """(B, 2) standard deviations of velocities: `change` is that of the keyframe, at least its robot's mean."""
    noise, change = (np.concatenate([getattr(k, name) for k in keyframes]) for name in ("noise", "change"))
    count = np.maximum(np.bincount(robots), 1)
    usual = np.stack([np.bincount(robots, of) / count for of in change.T], axis=1)[robots]
    return np.sqrt(noise + np.maximum(0.0, np.maximum(change, usual)))


def is_significant(velocity: Array, sigma: Array) -> Mask:
    """(B,) whether velocities (B, 3) are more than noise, with standard deviations (B,) of a coordinate."""
    return np.sum(velocity**2, axis=1) > chdtri(3, RIVAL) * sigma**2


def _are_determined(robot: Index, camera: Index) -> Mask:
    """(N,) detections of robots that two cameras or more see, and that have `MIN_SEEN` detections."""
    determined: Mask = count_checked(robot, camera, int(np.max(robot, initial=0)) + 1) >= MIN_SEEN
    return determined[robot]


def _since(cameras: CameraArray, exposures: Exposures) -> Array:
    """(8 C,) variances of what clocks and lenses change after the calibration, and of the smallest errors otherwise."""
    variance = np.tile((FREE_SIGMA * NEGLIGIBLE) ** 2, (len(cameras.names), 1))
    for k, name in enumerate(cameras.names):
        camera = cameras[name]
        clock_s = exposures.clock_sigma[exposures.camera == k].max(initial=0.0)
        variance[k, CAUSES["clock"]] += OFFSET_SIGMA_S**2 + clock_s**2
        focal = camera.lens_sigma[0] / camera.fx if camera.lens_sigma is not None else FOCAL_STABILITY
        variance[k, CAUSES["focal"]] += focal**2
    return variance.ravel()
