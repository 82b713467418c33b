# SPDX-License-Identifier: BSD-3-Clause
"""Runs a wand session: collects frames from running cameras until the calibration is precise enough.

Every few seconds, a trial calibration is computed from part of the frames, in a process of its own because GTSAM holds
the GIL. Covariances are inversely proportional to the number of frames, which predicts the result of all frames. The
session ends when

- every camera that sends frames is placed,
- no camera's own covariance adds more than 5 % to the error of a roundel's pixel, and
- the wand was seen in half of the image area that each camera shares with others, or in no new area for 15 s;

or when no roundel moves for 15 s: the wand was put down or carried away. While a camera is not placed, the session
waits for the wand to return.
"""

import os
import signal
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.pool import AsyncResult

import zenoh

from calib.errors import CalibrationError
from calib.live.collect import CollectedFrames, collect_frames
from calib.rig.rig import Rig
from calib.wand.calibrate import calibrate
from calib.wand.quality.assessment import assess
from calib.wand.scale import Distance
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Detections

MAX_SECONDS = 180.0  # of a session that ends by itself
TRIAL_EVERY_S = 4.0  # the shortest time between two trials
TRIAL_FRAMES = 150  # per camera: a trial takes a second or less
BLOCK_S = 0.5  # frames are selected in blocks of this duration, so that the motion between them stays known
MAX_ADDED_ERROR = 0.05  # that a camera's covariance may add to the error of a pixel, as a fraction of it
MIN_USED = 0.5  # of the image area that a camera shares with others
MIN_GROWTH = 0.01  # of the used area, summed over cameras: less counts as none
IDLE_S = 15.0  # without growth of the used area
GONE_S = 15.0  # without a roundel that moves: the wand is gone
PAUSE_S = 3.0  # without a roundel that moves: the progress line reports it


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
    """

    fault: str = ""
    unplaced: dict[str, str] = field(default_factory=dict)
    noise_ratio: dict[str, float] = field(default_factory=dict)
    used: dict[str, float] = field(default_factory=dict)
    advice: dict[str, str] = field(default_factory=dict)
    expected_mm: float | None = None
    grade: str = "D"
    rig: Rig | None = None


@dataclass(frozen=True, slots=True)
class SessionProgress:
    """The state of a running session.

    Attributes:
        seconds: elapsed.
        frames: number of frames with roundels, by camera.
        covered: fraction of the image in which roundels were detected, by camera.
        trial: the latest one.
        enough: whether the stopping rule is met.
        advice: what to do next.
    """

    seconds: float
    frames: dict[str, int]
    covered: dict[str, float]
    trial: Trial | None
    enough: bool
    advice: str

    @property
    def summary(self) -> str:
        """The elapsed time, and the expected result."""
        if self.trial is None or self.trial.expected_mm is None:
            return f"{self.seconds:.0f} s"
        return (
            f"{self.seconds:.0f} s, grade {self.trial.grade}, expected error {self.trial.expected_mm:.2f} mm"
        )

    def cells(self) -> list[tuple[str, ...]]:
        """One row per camera: name, frames, share of the image, used part of the shared area, noise ratio; the last
        two are empty before the first trial."""
        trial = self.trial or Trial()
        return [
            (
                name,
                str(frames),
                f"{self.covered.get(name, 0):.0%}",
                f"{trial.used[name]:.0%}" if name in trial.used else "",
                f"{trial.noise_ratio[name]:.2f}" if name in trial.noise_ratio else "",
            )
            for name, frames in self.frames.items()
        ]


@dataclass(slots=True)
class StoppingRule:
    """Decides when a session has enough frames; remembers when the used area last grew, and to how much."""

    most_used: float = 0.0
    grew_s: float = 0.0

    def is_met(self, trial: Trial, now_s: float) -> bool:
        """Whether more frames would not improve the result."""
        if (used := sum(trial.used.values())) > self.most_used + MIN_GROWTH:
            self.most_used, self.grew_s = used, now_s
        if trial.fault or trial.unplaced:
            return False
        # Variances add: (1 + ratio^2) ^ 1/2 < 1 + MAX_ADDED_ERROR.
        precise = max(trial.noise_ratio.values()) ** 2 < (1 + MAX_ADDED_ERROR) ** 2 - 1
        return precise and (min(trial.used.values()) >= MIN_USED or now_s - self.grew_s > IDLE_S)


def run_wand_session(
    session: zenoh.Session,
    arena: str,
    settings: WandSession,
    show: Callable[[SessionProgress], None] = lambda progress: None,
    stop: threading.Event | None = None,
) -> tuple[CollectedFrames, str]:
    """Collect the detections of all cameras of an arena while a person waves the wand.

    Args:
        session, arena: where cameras publish.
        settings: the rig, the wand, and when to end.
        show: called from this thread a few times a second.
        stop: ends the session from another thread.

    Returns:
        the frames, and the reason for the end.

    Raises:
        CalibrationError: no message arrived.
    """
    rule = StoppingRule()
    with _TrialSolver(settings) as solver:

        def inspect(collected: CollectedFrames, elapsed: float) -> str:
            if stop is not None and stop.is_set():
                return "stopped by the user"
            trial = solver.update(collected.messages, elapsed)
            enough = trial is not None and rule.is_met(trial, elapsed)
            show(summarize(collected, elapsed, trial, enough))
            if enough and settings.stops_itself:
                return "more frames would not improve the result"
            is_gone = settings.stops_without_wand and is_wand_gone(collected, elapsed, trial, settings.trials)
            return f"no roundel moved for {GONE_S:.0f} s" if is_gone else ""

        return collect_frames(session, arena, settings.seconds, inspect)


def is_wand_gone(collected: CollectedFrames, elapsed: float, trial: Trial | None, trials: bool) -> bool:
    """Whether the wand was waved and is gone; with trials, only once one of them places all cameras."""
    is_placed = not trials or (trial is not None and not trial.fault and not trial.unplaced)
    return is_placed and _still_s(collected, elapsed) > GONE_S


def _still_s(collected: CollectedFrames, elapsed: float) -> float:
    """For how long no roundel moved, seconds; 0 before the first motion."""
    return 0.0 if collected.moved_s is None else elapsed - collected.moved_s


def summarize(
    collected: CollectedFrames, elapsed: float, trial: Trial | None, enough: bool
) -> SessionProgress:
    """The progress of a session, with advice."""
    covered = {name: coverage.share() for name, coverage in sorted(collected.coverage.items())}
    advice = _advise(collected, elapsed, trial, enough)
    return SessionProgress(elapsed, dict(sorted(collected.frames.items())), covered, trial, enough, advice)


def _advise(collected: CollectedFrames, elapsed: float, trial: Trial | None, enough: bool) -> str:
    if enough:
        return "there are enough frames"
    if silent := collected.silent_cameras(elapsed):
        return _name_silent(silent, len(collected.last_seen_s))
    if not collected.frames:
        return "waiting for roundels" if collected.messages else "waiting for cameras"
    if (still_s := _still_s(collected, elapsed)) > PAUSE_S:
        return (
            f"no roundel has moved for {still_s:.0f} s: wave on, or end the session; once all cameras are placed it "
            f"ends by itself after {GONE_S:.0f} s"
        )
    return _advise_by(trial) if trial is not None else "wave the wand where two cameras or more see it"


def _advise_by(trial: Trial) -> str:
    if trial.fault:
        return trial.fault
    if trial.unplaced:
        name, reason = next(iter(trial.unplaced.items()))
        return f"camera '{name}' is not placed yet: {reason}"
    name = min(trial.used, key=trial.used.__getitem__)
    if trial.used[name] < MIN_USED and trial.advice.get(name):
        return f"{name}: {trial.advice[name]}"
    weakest = max(trial.noise_ratio, key=trial.noise_ratio.__getitem__)
    return f"continue, mostly in front of '{weakest}'"


def _name_silent(silent: list[str], n_cameras: int) -> str:
    if len(silent) == n_cameras:
        return "no camera sends frames any more; check that the server runs"
    return f"{' and '.join(map(repr, silent))}: no frames any more; check that the camera's program runs"


def _init_trial_process() -> None:
    """Run at low priority, so that cameras keep the processor, and leave Ctrl-C to the main process."""
    os.nice(10)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


class _TrialSolver:
    """Computes trials, one at a time, in a process of its own."""

    def __init__(self, settings: WandSession) -> None:
        self._settings = settings
        self._pool = get_context("spawn").Pool(1, _init_trial_process) if settings.trials else None
        self._running: AsyncResult[Trial] | None = None
        self._latest: Trial | None = None
        self._next_s = settings.trial_every_s

    def __enter__(self) -> "_TrialSolver":
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.terminate()
            self._pool.join()

    def update(self, messages: Sequence[Detections], now_s: float) -> Trial | None:
        """Collect a finished trial, and start the next one when it is due; returns the latest finished one."""
        if self._running is not None and self._running.ready():
            self._latest, self._running = self._running.get(), None
            self._next_s = now_s + self._settings.trial_every_s
        if self._pool is not None and self._running is None and now_s >= self._next_s and messages:
            part = select_blocks(messages)
            share = len(part) / len(messages)
            self._running = self._pool.apply_async(compute_trial, (self._settings, part, share))
        return self._latest


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
