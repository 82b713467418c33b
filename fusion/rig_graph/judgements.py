# SPDX-License-Identifier: BSD-3-Clause
"""What the newest keyframes show of the cameras: judged in a process beside the one that tracks.

`judge_latest`  which hypothesis explains the longest window in which nothing changed, and what it measures
`watch`         whether other errors of cameras explain the newest keyframes: a tenth of the work
`confirm`       whether the one of three cameras that is blamed moved from one moment to the next
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from scipy.special import chdtri

from calib.rig.camera_errors import ERRORS
from camera_node.foundation.arrays import Array
from camera_node.geometry.pose import Pose
from fusion.model.frames import FrameSet
from fusion.model.observations import CameraArray, MarkerTable
from fusion.model.states import Snapshot
from fusion.rig_graph.clock_walk import other_offsets
from fusion.rig_graph.hypotheses import (
    CAUSES,
    FALSE_ALARM,
    MIN_FOR_PAIRS,
    RIVAL,
    Fit,
    Hypothesis,
    Verdict,
    Window,
    equations_by,
    fit,
    has_changed,
    judge,
    most_explained,
    retract,
    several_markers,
)
from fusion.rig_graph.keyframes import N_MEAN, Keyframe, Moments, window_of
from fusion.rig_graph.robot_shapes import RobotShapes, Shape

Equations = tuple[int, Array, Array]  # Unix time in ns, and H (8 C, 8 C) and y (8 C,) of `ClockWalk.update`
# Keyframes that are judged: the more, the better they determine a camera; the fewer, the sooner all of them are new.
WINDOWS = 24, 12, 6
CHANGED = 2.0  # ratio of the mean robust costs in both halves of a window in which something changed
# Mean robust cost that shows nothing: twice that of Gaussian noise, E[log(1 + chi2_2 / CAUCHY^2)].
USUAL = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """What the keyframes of a window show that were not measured before.

    Attributes:
        errors: of the cameras, by all of them.
        clocks: the same by at most six successive keyframes each, because clocks drift.
        shapes: by row of the robots.
    """

    errors: Equations
    clocks: tuple[Equations, ...]
    shapes: dict[int, Shape]


@dataclass(frozen=True, slots=True)
class Watched:
    """What the newest keyframes show at the start of a fit.

    Attributes:
        gain: by how much less they cost with other errors of cameras, see `most_explained`.
        clock_gain: by how much less with another offset of one clock.
        offsets_s: these offsets, s, either way, by camera: of the best and of all that explain as much but for chance,
            as both of two cameras do.
    """

    gain: float
    clock_gain: float
    offsets_s: dict[int, float]


@dataclass(frozen=True, slots=True)
class Unexplained:
    """Cameras contradict each other, and no hypothesis leaves nothing but noise: `scale` is by how much the errors of
    all of them would be larger than stated."""

    scale: float


Judgement = tuple[Window, Verdict, Measured | None]


def judge_latest(
    keyframes: Sequence[Keyframe],
    cameras: CameraArray,
    markers: MarkerTable,
    shapes: RobotShapes,
    since_ns: int,
    moved: Sequence[str],
) -> Judgement | Unexplained | None:
    """Judge the longest window in which nothing changed; without one, what the newest keyframes contradict. What its
    keyframes after a time show of the errors of cameras and the shapes of robots is measured."""
    unexplained = None
    for n in WINDOWS:
        if n <= len(keyframes):
            window, starts = window_of(keyframes[-n:], cameras, markers)
            if not len(window.camera):
                continue
            verdict = judge(window, starts, [cameras.index[name] for name in moved])
            newest = np.arange(n) >= n - min(WINDOWS)
            is_constant = newest.all() or not has_changed(window, verdict.fit, newest)
            if is_constant and verdict.fit.is_adequate() and _is_stationary(verdict.fit.by_keyframe(window)):
                return window, verdict, _measure(window, verdict, keyframes[-n:], shapes, since_ns)
            is_unexplained = len(verdict.cameras) > 0 and not verdict.fit.is_adequate()
            unexplained = Unexplained(verdict.scale) if is_unexplained else None
    return unexplained


def watch(keyframes: Sequence[Keyframe], cameras: CameraArray, markers: MarkerTable) -> Watched:
    """Whether other errors of cameras explain keyframes: robots explain them to a frame set, and a judgement takes ten
    times as long."""
    window, _ = window_of(keyframes, cameras, markers, may_have_moved=False)
    if not len(window.camera):
        return Watched(0.0, 0.0, {})
    none = fit(window, Hypothesis.of(None, (), len(window.names)), max_iterations=0)
    gains, offsets = other_offsets(window.covariance(1.0), *none.equations)
    likely = np.flatnonzero(gains > gains.max() - chdtri(1, RIVAL))
    of_clocks = float(gains.max()), {int(k): abs(float(offsets[k])) for k in likely}
    return Watched(most_explained(window, none), *of_clocks)


def blames_one_of_three(window: Window, verdict: Verdict) -> bool:
    """Whether a camera is to be excluded that `confirm` should judge: two others that moved together look like it."""
    return verdict.cause == "pose" and len(seeing(window)) <= MIN_FOR_PAIRS


def confirm(
    judged: Judgement,
    cameras: CameraArray,
    markers: MarkerTable,
    moments: Sequence[tuple[FrameSet, Snapshot]],
) -> Judgement:
    """The judgement that one of three cameras is at fault if `moments` show that it moved; else an undecided one."""
    window, verdict, measured = judged
    if moments and _moved_alone(Moments(*zip(*moments, strict=True)), (cameras, markers), window, verdict):
        return judged
    undecided = replace(verdict, cause=None, cameras=tuple(np.unique(window.camera).tolist()))
    return window, undecided, measured


@dataclass(frozen=True, slots=True, eq=False)
class _Explained:
    """A frame set by two poses of a camera: the robots by the new one, and how much more that one explains."""

    keyframe: Keyframe
    moved: Fit
    gain: float


def _moved_alone(
    moments: Moments, scene: tuple[CameraArray, MarkerTable], window: Window, verdict: Verdict
) -> bool:
    """Whether one of three cameras moved from one moment to the next, while the robots were where they are predicted.

    If the two others had moved together, all images of robots and cameras would be the same, but the robots would
    have jumped with these. A motion without such a moment shows nothing.
    """
    (camera,), limit = verdict.cameras, chdtri(CAUSES["pose"].stop, FALSE_ALARM)
    T = window.T.copy()
    T[camera] = retract(window.T, verdict.fit.errors)[camera]
    none, (cameras, markers), name = Hypothesis.of(None, (), len(window.names)), scene, window.names[camera]
    camera_there = msgspec.structs.replace(cameras[name], T_world_cam=Pose.from_matrix(T[camera]))
    placed = CameraArray(cameras.as_dict() | {name: camera_there}, cameras.error_scale)

    def explain(at: int, known: int, mean: tuple[int, int]) -> _Explained | None:
        keyframes = [moments.keyframe(at, known, mean, (array, markers)) for array in (cameras, placed)]
        seen = [window_of([k], cameras, markers)[0] for k in keyframes if k is not None]
        if keyframes[0] is None or not len(seen[0].camera):
            return None
        shown = max(seen, key=lambda w: np.count_nonzero(w.camera == camera))
        moved = fit(replace(shown, T=T), none)
        return _Explained(keyframes[0], moved, fit(replace(shown, T=window.T), none).cost - moved.cost)

    k, old, new = _change(explain, len(moments.snapshots))
    if old is None or new is None or old.gain > -limit or new.gain < old.gain + 2 * limit:
        return False
    expected = new.keyframe.states
    robots = expected.retract(new.moved.bodies)
    X = window.T[camera] @ np.linalg.inv(T[camera])  # the motion of the others, if the camera stayed
    jumped = replace(robots, R=X[:3, :3] @ robots.R, p=robots.p @ X[:3, :3].T + X[:3, 3])
    sigma = np.repeat(moments.prediction_sigma(k, new.keyframe.robots), 3, axis=1)
    stay, jump = (np.sum((s.minus(expected)[:, :6] / sigma) ** 2) for s in (robots, jumped))
    return bool(stay < chdtri(sigma.size, FALSE_ALARM) and jump - stay > limit)


def _change(
    explain: Callable[[int, int, tuple[int, int]], _Explained | None], n: int
) -> tuple[int, _Explained | None, _Explained | None]:
    """The moment, of n, after which the new pose explains more, by bisection, and then by the robots' motion before:
    the filter follows images that changed. With the frame sets there and next."""
    before, after = N_MEAN, n - N_MEAN - 1
    start = explain(before, before, (0, 2 * N_MEAN)) if before < after else None
    if start is None or start.gain > 0:  # it was so from the start
        return 0, None, None
    while after - before > 1:
        middle = (before + after) // 2
        found = explain(middle, middle, (middle - N_MEAN, middle + N_MEAN))
        before, after = (before, middle) if found is not None and found.gain > 0 else (middle, after)
    first, last = max(N_MEAN + 1, before - N_MEAN), min(before + N_MEAN, n - 1)
    steps = [(k, *(explain(at, k, (k - N_MEAN, k)) for at in (k, k + 1))) for k in range(first, last)]
    known = [(k, old, new) for k, old, new in steps if old is not None and new is not None]
    return max(known, key=lambda step: step[2].gain - step[1].gain, default=(0, None, None))


def _measure(
    window: Window, verdict: Verdict, keyframes: Sequence[Keyframe], shapes: RobotShapes, since_ns: int
) -> Measured | None:
    times = np.array([keyframe.t_ns for keyframe in keyframes])
    is_new = times > since_ns
    shown = window.select(is_new)
    if not len(shown.camera):
        return None
    found = fit(shown, replace(verdict.fit.hypothesis, robots=several_markers(shown)))
    markers = {robot: np.flatnonzero(window.owner == robot) for robot in found.hypothesis.robots}
    n = np.count_nonzero(is_new)
    n_parts = math.ceil(n / min(WINDOWS))
    number = (np.cumsum(is_new) - 1) * n_parts // n
    parts = [is_new & (number == part) for part in range(n_parts)]
    return Measured(
        (round(times[is_new].mean()), *found.equations),
        tuple((round(times[part].mean()), *equations_by(shown, found, part)) for part in parts),
        shapes.learned({r: found.equations_of_places(rows) for r, rows in markers.items()}),
    )


def seeing(window: Window) -> list[str]:
    """The cameras with enough detections to determine their errors."""
    count = np.bincount(window.camera, minlength=len(window.names))
    return [name for name, k in zip(window.names, count, strict=True) if k >= ERRORS]


def _is_stationary(cost: Array) -> bool:
    """Whether the mean costs (K,) of keyframes, in order of time, are alike in both halves."""
    half = len(cost) // 2
    if not (np.isfinite(cost[:half]).any() and np.isfinite(cost[half:]).any()):
        return False
    before, after = np.nanmean(cost[:half]), np.nanmean(cost[half:])
    return bool(max(before, after) < CHANGED * min(before, after) or max(before, after) < USUAL)
