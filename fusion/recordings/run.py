# SPDX-License-Identifier: BSD-3-Clause
"""Fuses recorded detections: every frame set, by the code that runs live."""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from calib.rig.camera import Camera
from calib.rig.recording import as_they_arrived
from camera_node.foundation.errors import ConfigError
from camera_node.protocol.messages import Detections
from camera_node.sources.recorded_detections import detect_frames, read_observations
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.model.limits import Limits
from fusion.model.robots import Robot
from fusion.recordings.report import Summary
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.tracking.result import TrackingResult
from fusion.tracking.smoothing import Smoother
from fusion.tracking.tracker import Tracker


@dataclass(frozen=True)
class OfflineArena:
    """The arena of a recording.

    Attributes:
        cameras: the placed ones.
        robots: see `load_robots`.
        rate_hz: poses a second; without it the rate of the fastest camera.
        limits: see `Limits`.
        smooth: estimate each pose from the whole recording, not only from the frames before it.

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


def fuse_recording(
    messages: Iterable[tuple[int, Detections]], arena: OfflineArena, summary: Summary | None = None
) -> Iterator[TrackingResult]:
    """Fuse recorded detections.

    Args:
        messages: when each message of a camera arrived (ns), and the message, in order of arrival.
        arena: its cameras and robots.
        summary: counts the results, the skipped messages and the moved cameras.
    """
    summary = Summary() if summary is None else summary
    tracker = Tracker(arena.cameras, arena.robots, arena.limits)
    yield from _fuse(_synchronize(messages, tracker, arena, summary.faults), tracker, arena, summary)


def fuse_frame_sets(
    frame_sets: Iterable[FrameSet], arena: OfflineArena, summary: Summary | None = None
) -> Iterator[TrackingResult]:
    """Fuse frame sets, as those that the server formed; see `fuse_recording`."""
    tracker = Tracker(arena.cameras, arena.robots, arena.limits)
    yield from _fuse(frame_sets, tracker, arena, Summary() if summary is None else summary)


def _fuse(
    frame_sets: Iterable[FrameSet], tracker: Tracker, arena: OfflineArena, summary: Summary
) -> Iterator[TrackingResult]:
    smoother = Smoother(tracker.table.names) if arena.smooth else None
    for frame_set in frame_sets:
        fused = tracker.track(frame_set)
        summary.add(fused)
        if smoother is None:
            yield fused
        else:
            smoother.add(fused)
        for correction in tracker.check_extrinsics(frame_set, fused):
            summary.add_correction(correction, frame_set.t_ns)
    if smoother is not None:
        yield from smoother.smooth()


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
    tracker: Tracker,
    arena: OfflineArena,
    faults: Counter[str],
) -> Iterator[FrameSet]:
    synchronizer = FrameSynchronizer.at_rate(arena.rate_hz, arena.limits.lateness_ms)
    for received_ns, message in messages:
        camera = arena.cameras.get(message.camera)
        if camera is None:
            faults[f"frames of camera '{message.camera}', which has no pose in the rig"] += 1
        elif (message.width, message.height) != (camera.width, camera.height):
            faults[f"frames of camera '{message.camera}', whose size is not the rig's"] += 1
        else:
            frame = tracker.admit(CalibratedFrame.of(message, camera, received_ns))
            if frame is not None:
                synchronizer.add(frame)
            else:
                synchronizer.ignore(message.camera)
                faults[
                    f"frames of camera '{message.camera}', whose clock was wrong or whose image was frozen"
                ] += 1
            yield from synchronizer.take(received_ns)
    for name, late in synchronizer.late.items():
        if late:
            faults[f"frames of camera '{name}' that arrived too late"] += late
    yield from synchronizer.finish()
