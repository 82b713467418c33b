# SPDX-License-Identifier: BSD-3-Clause
"""Trials of a wand session: calibrations from part of the frames, in another process because GTSAM holds the GIL.

Covariances are inversely proportional to the number of frames, which predicts the result of all frames.
"""

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import BrokenExecutor, Future
from dataclasses import dataclass, field, replace

from calib.errors import CalibrationError
from calib.rig.rig import Rig
from calib.wand.calibrate import calibrate
from calib.wand.quality.grade import assess
from calib.wand.scale import Distance
from camera_node.foundation.background_process import BackgroundProcess
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Detections

MAX_SECONDS = 180.0  # of a session that ends by itself
TRIAL_EVERY_S = 4.0  # the shortest time between two trials
TRIAL_FRAMES = 150  # per camera: a trial takes a second or less
BLOCK_S = 0.5  # frames are selected in blocks of this duration, so that the motion between them stays known


@dataclass(frozen=True, slots=True, kw_only=True)
class WandSession:
    """The settings of a wand session.

    Attributes:
        rig: intrinsics of the cameras.
        wand: the wand.
        distance: between two cameras, measured; the scale of trials if the wand has one marker.
        seconds: the longest duration.
        trials: whether trial calibrations are computed.
        trial_every_s: the shortest time between two trials.
        stops_itself: whether the session ends when a trial is precise enough.
        stops_without_wand: whether it ends when the wand is gone.
    """

    rig: Rig
    wand: Body
    distance: Distance | None = None
    seconds: float = MAX_SECONDS
    trials: bool = True
    trial_every_s: float = TRIAL_EVERY_S
    stops_itself: bool = True
    stops_without_wand: bool = True


@dataclass(frozen=True, slots=True)
class Trial:
    """A calibration from part of the frames, and its prediction for all of them.

    Attributes:
        fault: why no two cameras could be placed; empty if they were.
        unplaced: the reason, by name of each camera that could not be placed.
        noise_ratio: image error by the camera's own covariance, over the noise of its pixels, by camera.
        used: fraction of the image area shared with others in which the wand was seen, by camera.
        advice: where to wave next, by camera.
        expected_mm: expected error of points across the arena; None for a rig without scale.
        grade: of the trial.
        rig: the cameras that it placed, for a preview; None if it failed.
        until_s: when its last frame was recorded, seconds since the session began.
    """

    fault: str = ""
    unplaced: dict[str, str] = field(default_factory=dict)
    noise_ratio: dict[str, float] = field(default_factory=dict)
    used: dict[str, float] = field(default_factory=dict)
    advice: dict[str, str] = field(default_factory=dict)
    expected_mm: float | None = None
    grade: str = "D"
    rig: Rig | None = None
    until_s: float = 0.0


class TrialSolver:
    """Computes trials, one at a time, in a process of its own; a process that ends early is replaced."""

    def __init__(self, settings: WandSession) -> None:
        self._settings = settings
        self._executor = BackgroundProcess() if settings.trials else None
        self._running: Future[Trial] | None = None
        self._latest: Trial | None = None
        self._next_s, self._begun_s = settings.trial_every_s, 0.0

    def __enter__(self) -> "TrialSolver":
        return self

    def __exit__(self, *_: object) -> None:
        """Do not wait: the process ends with the trial that it computes."""
        if self._executor is not None:
            self._executor.shutdown(wait=False, cancel_futures=True)

    def update(self, messages: Sequence[Detections], now_s: float) -> Trial | None:
        """Collect a finished trial, and start the next one when it is due; returns the latest finished one."""
        if self._executor is None:
            return None
        if self._running is not None and self._running.done():
            self._latest = replace(_collect(self._running), until_s=self._begun_s)
            self._running = None
            self._next_s = now_s + self._settings.trial_every_s
        if self._running is None and now_s >= self._next_s and messages:
            part = select_blocks(messages)
            share = len(part) / len(messages)
            self._running = self._executor.submit(compute_trial, self._settings, part, share)
            self._begun_s = now_s
        return self._latest


def _collect(finished: Future[Trial]) -> Trial:
    """The trial of a finished computation; a failed one if its process ended before."""
    try:
        return finished.result(0)
    except BrokenExecutor as error:
        return Trial(fault=f"the process of the trials ended ({error}); the session continues")


def select_blocks(messages: Sequence[Detections], frames: int = TRIAL_FRAMES) -> list[Detections]:
    """Select messages in evenly spaced blocks of 0.5 s, with about `frames` of the camera that has most."""
    most = max(Counter(message.camera for message in messages).values())
    stride = -(-most // frames)
    start = min(message.t_ns for message in messages)
    return [m for m in messages if int((m.t_ns - start) * 1e-9 / BLOCK_S) % stride == 0]


def compute_trial(settings: WandSession, part: Sequence[Detections], share: float) -> Trial:
    """Calibrate from part of the messages, a `share` of all, and predict the precision of all."""
    try:
        result = calibrate(settings.rig, settings.wand, part, settings.distance)
    except CalibrationError as error:
        return Trial(fault=str(error))
    except Exception as error:  # a failed trial must not end the session
        return Trial(
            fault=f"the trial calibration failed ({type(error).__name__}: {error}); the session continues"
        )
    quality, scale = assess(result, settings.wand), share**0.5
    sending = {message.camera for message in part}
    return Trial(
        unplaced={name: reason for name, reason in quality.unplaced.items() if name in sending},
        noise_ratio={c.name: scale * c.noise_ratio for c in quality.cameras},
        used={c.name: 1 - c.figures["unused"] for c in quality.cameras},
        advice={c.name: c.wave_next for c in quality.cameras},
        expected_mm=quality.expected.typical_mm if quality.expected else None,
        grade=quality.grade,
        rig=result.rig,
    )
