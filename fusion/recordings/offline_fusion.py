# SPDX-License-Identifier: BSD-3-Clause
"""Fuses recorded detections: every frame set, by the code that runs live.

The frame sets are those that the server formed, so that a replay repeats its poses exactly: which frames form a set
depends on when they arrived at the server, and a recorder does not know that. Without a server they are formed from the
times of arrival.
"""

import heapq
import logging
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from calib.rig.camera import Camera
from calib.rig.recording import as_they_arrived, new_recording, read_messages
from calib.rig.rig import load_rig
from camera_node.foundation.errors import ConfigError
from camera_node.protocol.messages import Detections, Keys, encode
from camera_node.sources.recorded_detections import detect_frames, read_observations
from fusion.errors import FusionError
from fusion.model.corrections import ExtrinsicsCorrection, RigRefinement
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.model.limits import Limits
from fusion.model.robots import Robot
from fusion.protocol.pose_messages import FusedFrames
from fusion.recordings.arena_recording import DETECTIONS, FRAMES, ArenaRecording, skipped
from fusion.rig_graph.recorded_judgements import RecordedJudgements
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.server.ingest import Refusal, admit
from fusion.tracking.result import NO_SOLUTION, TOO_MANY_UNASSIGNED, TrackingResult
from fusion.tracking.smoothing import Smoother
from fusion.tracking.tracker import Tracker

log = logging.getLogger("fusion.replay")
Held = dict[tuple[str, int], Detections]  # by camera and stamp
HELD_NS = 10_000_000_000
STATES = ("tracked", "coasting", "lost")
REFUSED: dict[Refusal, str] = {
    "unknown camera": "which has no pose in the rig",
    "wrong image size": "whose size is not the rig's",
}


@dataclass(frozen=True)
class OfflineArena:
    """The arena of a recording.

    Attributes:
        cameras: the placed ones.
        robots: see `load_robots`.
        rate_hz: poses a second; without it the rate of the fastest camera.
        limits: see `Limits`.
        smooth: estimate each pose from later frames, too (`Smoother`).

    Raises:
        ConfigError: the rate is implausible.
    """

    cameras: dict[str, Camera]
    robots: dict[str, Robot]
    rate_hz: float | None = None
    limits: Limits = field(default_factory=Limits)
    smooth: bool = False

    def __post_init__(self) -> None:
        if self.rate_hz is not None and not 0.1 <= self.rate_hz <= 1000:
            raise ConfigError(f"--rate-hz {self.rate_hz} is not within 0.1 and 1000")


@dataclass
class Summary:
    """Counts over a run."""

    frame_sets: int = 0
    states: Counter[tuple[str, str]] = field(default_factory=Counter)
    used: Counter[str] = field(default_factory=Counter)
    unused: Counter[str] = field(default_factory=Counter)
    squared_px: dict[str, float] = field(default_factory=dict)
    unlabeled: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    moves: list[str] = field(default_factory=list)
    not_acquired: dict[str, str] = field(default_factory=dict)

    def add(self, fused: TrackingResult) -> None:
        """Count a fused frame set."""
        self.frame_sets += 1
        self.states.update((pose.robot, pose.state) for pose in fused.poses)
        self.unlabeled += int((fused.markers.robot_index() < 0).sum())
        self.faults.update(f"{TOO_MANY_UNASSIGNED}, of camera '{name}'" for name in fused.crowded)
        for name, use in fused.cameras.items():
            self.used[name] += use.used
            self.unused[name] += use.unused
            self.squared_px[name] = self.squared_px.get(name, 0.0) + use.squared_px

    def add_correction(self, correction: ExtrinsicsCorrection | RigRefinement, t_ns: int) -> None:
        """Note that a camera was moved, or recalibrated after a move, or that all are known better."""
        if isinstance(correction, RigRefinement):
            self.moves.append(f"{correction}, at t_ns {t_ns}; the rig file is unchanged")
            return
        if correction.camera is None:
            event = f"seen at t_ns {t_ns}; its detections are excluded from then on"
        else:
            event = f"recalibrated at t_ns {t_ns} and used again; the rig file is unchanged"
        self.moves.append(f"moved: camera '{correction.name}', {event}")

    def lines(self, robots: Iterable[str]) -> Iterator[str]:
        """The summary, one line a subject."""
        yield f"{self.frame_sets} frame sets, {self.unlabeled} unlabeled markers"
        for robot in robots:
            shares = (f"{s} {self.states[robot, s] / max(self.frame_sets, 1):.1%}" for s in STATES)
            why = f"; at the end: {self.not_acquired[robot]}" if robot in self.not_acquired else ""
            yield f"{robot}: {', '.join(shares)}{why}"
        for name in sorted(self.used):
            used = self.used[name]
            residual = f"residual {np.sqrt(self.squared_px[name] / used):.2f} px, " if used else ""
            yield f"{name}: {residual}{used} detections assigned, {self.unused[name]} not"
        for reason, count in sorted(self.faults.items()):
            yield f"skipped: {count} {reason}"
        yield from self.moves


def fuse_recording(
    messages: Iterable[tuple[int, Detections]], arena: OfflineArena, summary: Summary | None = None
) -> Iterator[TrackingResult]:
    """Fuse recorded detections.

    Args:
        messages: when each message of a camera arrived (ns), and the message, in order of arrival.
        arena: its cameras and robots.
        summary: counts the results, the skipped messages and the moved cameras.

    Raises:
        FusionError: no frame could be used.
    """
    summary = Summary() if summary is None else summary
    tracking = _Tracking(arena, summary.faults)
    yield from _fuse(_synchronize(messages, tracking, arena, summary.faults), tracking, arena, summary)


def fuse_again(
    recording: ArenaRecording, arena: OfflineArena, summary: Summary, forms_sets: bool
) -> Iterator[TrackingResult]:
    """Fuse a recording: the server's frame sets, or, with `forms_sets` or if it holds none, those that its
    detections form by their times of arrival."""
    if forms_sets or not recording.counts[FRAMES]:
        return fuse_recording(recording.messages(DETECTIONS), arena, summary)
    return fuse_frame_sets(recorded_frame_sets(recording, arena.cameras, summary.faults), arena, summary)


def fuse_frame_sets(
    frame_sets: Iterable[FrameSet], arena: OfflineArena, summary: Summary | None = None
) -> Iterator[TrackingResult]:
    """Fuse frame sets, as those that the server formed; see `fuse_recording`."""
    summary = Summary() if summary is None else summary
    yield from _fuse(frame_sets, _Tracking(arena, summary.faults), arena, summary)


class _Tracking:
    """A tracker that acquires all robots again after a frame set without a solution, as the live server's does.

    Attributes:
        tracker: the present one.
    """

    def __init__(self, arena: OfflineArena, faults: Counter[str]) -> None:
        self.tracker = Tracker(arena.cameras, arena.robots, arena.limits)
        self._faults = faults
        self._judgements: RecordedJudgements | None = None  # those of a server

    def track(self, frame_set: FrameSet) -> TrackingResult | None:
        """The robots after a frame set; None if it has no solution, which is counted."""
        if self._judgements is None and frame_set.judged is not None:
            self._judgements = RecordedJudgements()
            self.tracker.monitors.rig.doubt()  # as the server's is from the start
        try:
            return self.tracker.track(frame_set)
        except Exception:  # NumPy's and GTSAM's of a singular system, or a bug that some input shows
            self._faults[NO_SOLUTION] += 1
            log.exception(
                "the frame set at t_ns %d has no solution; robots are acquired again", frame_set.t_ns
            )
            self.tracker = self.tracker.restarted()
            return None

    def check(self, frame_set: FrameSet) -> tuple[ExtrinsicsCorrection | RigRefinement, ...]:
        """Judge the cameras when the server did."""
        if self._judgements is not None and frame_set.judged is not None:
            self.tracker.monitors.rig.executor = self._judgements
            self._judgements.allow(frame_set.judged)
        return self.tracker.check_extrinsics(frame_set)


def _fuse(
    frame_sets: Iterable[FrameSet], tracking: _Tracking, arena: OfflineArena, summary: Summary
) -> Iterator[TrackingResult]:
    smoother = Smoother(tracking.tracker.table.names) if arena.smooth else None
    for frame_set in frame_sets:
        fused = tracking.track(frame_set)
        if fused is None:
            continue
        summary.add(fused)
        if smoother is None:
            yield fused
        else:
            yield from smoother.add(fused)
        for correction in tracking.check(frame_set):
            summary.add_correction(correction, frame_set.t_ns)
    summary.not_acquired = tracking.tracker.not_acquired()
    if not summary.frame_sets:
        placed = ", ".join(sorted(arena.cameras))
        raise FusionError(
            f"no frame could be used{skipped(summary.faults)}; give the rig of these cameras at this size (this one "
            f"has poses of {placed}); nothing was written"
        )
    if smoother is not None:
        yield from smoother.finish()


def read_detections(
    frames: Path | None, observations: Path | None, cameras: dict[str, Camera]
) -> list[tuple[int, Detections]]:
    """Detections of a folder of frames or of an `observations.csv`, as if each arrived at its true capture time.

    Raises:
        ConfigError: not exactly one of both is given, or it can't be read.
    """
    if frames is not None and observations is None:
        messages = detect_frames(frames)
    elif observations is not None and frames is None:
        messages = read_observations(observations, {name: (c.width, c.height) for name, c in cameras.items()})
    else:
        raise ConfigError("give either --frames FOLDER or --observations CSV")
    return as_they_arrived(messages, cameras)


def _synchronize(
    messages: Iterable[tuple[int, Detections]],
    tracking: _Tracking,
    arena: OfflineArena,
    faults: Counter[str],
) -> Iterator[FrameSet]:
    synchronizer = FrameSynchronizer.at_rate(arena.rate_hz, arena.limits.lateness_ms)
    for received_ns, message in messages:
        name, admitted = message.camera, admit(message, arena.cameras, received_ns)
        if not isinstance(admitted, CalibratedFrame):
            faults[f"frames of camera '{name}', {REFUSED[admitted]}"] += 1
            continue
        frame = tracking.tracker.admit(admitted)
        if frame is not None:
            synchronizer.add(frame)
        else:
            synchronizer.ignore(name)
            faults[f"frames of camera '{name}', whose clock was wrong or whose image was frozen"] += 1
        yield from synchronizer.take(received_ns)
    for name, late in synchronizer.late.items():
        if late:
            faults[f"frames of camera '{name}' that arrived too late"] += late
    yield from synchronizer.finish()


def recorded_frame_sets(
    recording: ArenaRecording, cameras: dict[str, Camera], faults: Counter[str]
) -> Iterator[FrameSet]:
    """Yield the server's frame sets from the first one of which all frames were recorded.

    Args:
        recording: of the server and its cameras.
        cameras: the placed ones, with the poses that the server used.
        faults: counts frames that the server used and the recording does not hold.
    """
    has_begun = False
    for fused, messages in _with_their_frames(recording):
        frames = tuple(_frames(fused, messages, cameras))
        n_missing = len(fused.cameras) - len(frames)
        has_begun = has_begun or (len(frames) > 0 and not n_missing)
        if has_begun:
            if n_missing:
                faults["frames that the server used and the recording does not hold"] += n_missing
            yield FrameSet(fused.t_ns, frames, fused.judged)


def _with_their_frames(recording: ArenaRecording) -> Iterator[tuple[FusedFrames, "Held"]]:
    """Each frame set, and the messages of cameras that arrived around it, by camera and stamp.

    A frame set waits for its frames, and a frame for its frame set, `HELD_NS` at most: the recording may be larger than
    the memory, and a recorder receives both within the limits of its own queue.
    """
    sets = deque[tuple[int, FusedFrames]]()
    held: Held = {}
    arrivals = deque[tuple[int, tuple[str, int]]]()
    for received_ns, message in recording.messages(DETECTIONS, FRAMES):
        if isinstance(message, FusedFrames):
            sets.append((received_ns, message))
        elif (key := (message.camera, message.t_ns)) not in held:  # the server refuses duplicates, too
            held[key] = message
            arrivals.append((received_ns, key))
        while sets and (sets[0][0] < received_ns - HELD_NS or _is_complete(sets[0][1], held)):
            yield sets.popleft()[1], held
        while arrivals and arrivals[0][0] < received_ns - 2 * HELD_NS:
            held.pop(arrivals.popleft()[1])
    for _, fused in sets:
        yield fused, held


def _is_complete(fused: FusedFrames, held: "Held") -> bool:
    return all((name, stamp_ns) in held for name, stamp_ns, *_ in fused.rows())


def _frames(fused: FusedFrames, messages: "Held", cameras: dict[str, Camera]) -> Iterator[CalibratedFrame]:
    for name, stamp_ns, t_ns, received_ns, clock_sigma_s, stamp_sigma_s in fused.rows():
        message = messages.get((name, stamp_ns))
        frame = None if message is None else admit(message, cameras, received_ns)
        if isinstance(frame, CalibratedFrame):
            yield replace(frame, t_ns=t_ns, clock_sigma_s=clock_sigma_s, stamp_sigma_s=stamp_sigma_s)


def cameras_of(recording: ArenaRecording, path: Path, rig: Path | None) -> dict[str, Camera]:
    """The placed cameras of the file `rig`, or else of the recording.

    Raises:
        ConfigError, CalibrationError: there is no rig, or it places no camera.
    """
    if rig is not None:
        return load_rig(rig).require_placed(rig)
    require_held(recording, path, rig=recording.rig)
    assert recording.rig is not None
    return recording.rig.placed()


def require_held(recording: ArenaRecording, path: Path, **held: object) -> None:
    """Raise ConfigError unless the recording or an option gives each of `held`, named as its option is."""
    if lacks := [name for name, value in held.items() if not value]:
        options = " and ".join(f"--{name} {name}.yaml" for name in lacks)
        raise ConfigError(
            f"{path} holds no {' and no '.join(lacks)}{skipped(recording.faults)}; give {options}"
        )


def write_recording(source: Path, out: Path, fused: Iterable[TrackingResult]) -> None:
    """Copy a recording with other poses and markers, which are logged at the times of their frame sets.

    Both are read while the copy is written, in the order of their times. A file at `out` is replaced at the end.

    Raises:
        ConfigError: the folder of `out` can't be written to, or the disk is full.
    """
    old = (e for e in read_messages(source, Counter()) if not e[0].endswith(("/pose", "/markers")))
    with new_recording(out) as writer:
        for entry in heapq.merge(old, _entries(source, fused), key=lambda entry: entry[2]):
            writer.put(*entry)


def _entries(source: Path, fused: Iterable[TrackingResult]) -> Iterator[tuple[str, bytes, int]]:
    """The recorded messages of poses and markers: key, bytes and time."""
    keys = Keys(
        next(key for key, _, _ in read_messages(source, Counter()) if key.endswith(DETECTIONS)).split("/")[0]
    )
    for frame_set in fused:
        for pose in frame_set.poses:
            yield keys.robot_pose(pose.robot), encode(pose), frame_set.t_ns
        yield keys.markers, encode(frame_set.markers), frame_set.t_ns
