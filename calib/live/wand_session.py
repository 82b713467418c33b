# SPDX-License-Identifier: BSD-3-Clause
"""A wand waved before running cameras: how far it is, and when more waving would not help.

The rule by which it stops. Every few seconds a part of what was seen is solved, in a process of its own because GTSAM
holds the GIL. Covariances shrink with the number of frames, so what all frames would give follows. It is enough when

- every camera that delivers is placed,
- no camera's own covariance adds more than 5 % to the error of a roundel's pixel, and
- half of what each camera shares with others was waved through, or nothing was added to that for 15 s.
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
from calib.live.collect import CollectedFrames, listen
from calib.rig.rig import Rig
from calib.wand.calibrate import calibrate
from calib.wand.quality.grade import assess
from calib.wand.scale import Distance
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Detections

MOST_S = 180.0  # that a wave may last when it ends by itself
TRIAL_EVERY_S = 4.0  # of new frames, at the least, between two trial solutions
TRIAL_FRAMES = 150  # of each camera: a solution of a second or less
BLOCK_S = 0.5  # frames that are taken or left together, so that the motion between them is known
ADDS = 0.05  # to the error of a pixel, that a camera's covariance may add
USED = 0.5  # of what a camera shares with others
IDLE_S = 15.0  # without anything added to that


@dataclass(frozen=True, slots=True)
class Trial:
    """What a part of the frames gives.

    Attributes:
        fault: why no two cameras could be placed; empty where they were.
        unplaced: why, by name of cameras that could not.
        strain: by camera, its covariance in the image over the noise of its pixels.
        used: by camera, the part of what it shares with others that was waved through.
        advice: by camera, where to wave next.
        expected_mm: the expected error of points across the arena, were all frames used; None without metres.
        grade: of the part.
    """

    fault: str = ""
    unplaced: dict[str, str] = field(default_factory=dict)
    strain: dict[str, float] = field(default_factory=dict)
    used: dict[str, float] = field(default_factory=dict)
    advice: dict[str, str] = field(default_factory=dict)
    expected_mm: float | None = None
    grade: str = "D"


@dataclass(frozen=True, slots=True)
class SessionProgress:
    """How far a wave is: seconds, frames with roundels and the share of the image that had them by camera, the latest
    trial, whether it is enough, and what to do next."""

    seconds: float
    frames: dict[str, int]
    covered: dict[str, float]
    trial: Trial | None
    enough: bool
    advice: str

    @property
    def standing(self) -> str:
        """How long it lasts, and what it would give now."""
        if self.trial is None or self.trial.expected_mm is None:
            return f"{self.seconds:.0f} s"
        return (
            f"{self.seconds:.0f} s, grade {self.trial.grade}, expected error {self.trial.expected_mm:.2f} mm"
        )

    def cells(self) -> list[tuple[str, ...]]:
        """By camera: its name, frames, share of the image, part of what it shares with others, strain; the last two are
        empty before the first trial."""
        trial = self.trial or Trial()
        return [
            (
                name,
                str(frames),
                f"{self.covered.get(name, 0):.0%}",
                f"{trial.used[name]:.0%}" if name in trial.used else "",
                f"{trial.strain[name]:.2f}" if name in trial.strain else "",
            )
            for name, frames in self.frames.items()
        ]


@dataclass(slots=True)
class Rule:
    """The rule by which a wave stops, with what it remembers from trial to trial."""

    best_used: float = 0.0
    grown: float = 0.0

    def judge(self, trial: Trial, now: float) -> bool:
        """Whether it is enough."""
        if (used := sum(trial.used.values())) > self.best_used + 0.01:
            self.best_used, self.grown = used, now
        if trial.fault or trial.unplaced:
            return False
        # Variances add: (1 + strain^2) ^ 1/2 < 1 + ADDS.
        precise = max(trial.strain.values()) ** 2 < (1 + ADDS) ** 2 - 1
        return precise and (min(trial.used.values()) >= USED or now - self.grown > IDLE_S)


def wave(
    session: zenoh.Session,
    arena: str,
    rig: Rig,
    wand: Body,
    seconds: float,
    tell: Callable[[SessionProgress], None] = lambda progress: None,
    ended: threading.Event | None = None,
    by_itself: bool = True,
    trials: bool = True,
    every_s: float = TRIAL_EVERY_S,
    distance: Distance | None = None,
) -> tuple[CollectedFrames, str]:
    """Collect the detections of all cameras of an arena while a wand is waved.

    Args:
        session, arena: where cameras publish.
        rig: intrinsics of the cameras.
        wand: the wand.
        seconds: how long at the most.
        tell: called a few times a second, with what a person wants to know; from this thread.
        ended: ends it from another thread.
        by_itself: whether it ends when a trial solution says that it is enough.
        trials: whether trial solutions are made.
        every_s: how long to wait from one to the next.
        distance: of two cameras, that trial solutions are scaled by where the wand has one marker.

    Returns:
        what was heard, and why it ended.

    Raises:
        CalibrationError: nothing came.
    """
    rule = Rule()
    with _Trials(rig, wand, distance, trials, every_s) as solver:

        def look(heard: CollectedFrames, passed: float) -> str:
            if ended is not None and ended.is_set():
                return "ended by hand"
            trial = solver.step(heard.messages, passed)
            enough = trial is not None and rule.judge(trial, passed)
            tell(progress(heard, passed, trial, enough))
            return "more waving would not help" if enough and by_itself else ""

        return listen(session, arena, seconds, look)


def progress(heard: CollectedFrames, passed: float, trial: Trial | None, enough: bool) -> SessionProgress:
    """What to tell a person."""
    covered = {name: coverage.share() for name, coverage in sorted(heard.coverage.items())}
    return SessionProgress(
        passed,
        dict(sorted(heard.frames.items())),
        covered,
        trial,
        enough,
        _advise(heard, passed, trial, enough),
    )


def _advise(heard: CollectedFrames, passed: float, trial: Trial | None, enough: bool) -> str:
    if enough:
        return "that is enough"
    if lost := heard.silent(passed):
        return _name_lost(lost, len(heard.latest))
    if not heard.frames:
        return "waiting for roundels" if heard.messages else "waiting for cameras"
    return _advise_on(trial) if trial is not None else "wave the wand where two cameras or more see it"


def _advise_on(trial: Trial) -> str:
    if trial.fault:
        return trial.fault
    if trial.unplaced:
        name, why = next(iter(trial.unplaced.items()))
        return f"'{name}' has no place yet: {why}"
    name = min(trial.used, key=trial.used.__getitem__)
    if trial.used[name] < USED and trial.advice.get(name):
        return f"{name}: {trial.advice[name]}"
    weakest = max(trial.strain, key=trial.strain.__getitem__)
    return f"go on, most before '{weakest}'"


def _name_lost(lost: list[str], cameras: int) -> str:
    if len(lost) == cameras:
        return "no camera sends any more: does the server run?"
    return f"{' and '.join(map(repr, lost))}: no frames any more; does its program run?"


def _stand_back() -> None:
    """In the trials' process: leave the processor to cameras, and Ctrl-C to who waves."""
    os.nice(10)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


class _Trials:
    """Trial solutions, one at a time, in a process of their own."""

    def __init__(self, rig: Rig, wand: Body, distance: Distance | None, wanted: bool, every_s: float) -> None:
        self._told, self._every_s = (rig, wand, distance), every_s
        self._pool = get_context("spawn").Pool(1, _stand_back) if wanted else None
        self._running: AsyncResult[Trial] | None = None
        self._latest: Trial | None = None
        self._due = every_s

    def __enter__(self) -> "_Trials":
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.terminate()
            self._pool.join()

    def step(self, messages: Sequence[Detections], now: float) -> Trial | None:
        """Take a finished trial, start another when it is due; the latest one."""
        if self._running is not None and self._running.ready():
            self._latest, self._running = self._running.get(), None
            self._due = now + self._every_s
        if self._pool is not None and self._running is None and now >= self._due and messages:
            part = thin(messages)
            share = len(part) / len(messages)
            self._running = self._pool.apply_async(try_part, (*self._told, part, share))
        return self._latest


def thin(messages: Sequence[Detections], frames: int = TRIAL_FRAMES) -> list[Detections]:
    """Messages of whole half seconds, evenly spread, with about `frames` of the camera that has most."""
    most = max(Counter(message.camera for message in messages).values())
    stride = -(-most // frames)
    start = min(message.t_ns for message in messages)
    return [m for m in messages if int((m.t_ns - start) * 1e-9 / BLOCK_S) % stride == 0]


def try_part(
    rig: Rig, wand: Body, distance: Distance | None, part: Sequence[Detections], share: float
) -> Trial:
    """Solve a part, `share` of all frames, and say what all of them would give."""
    try:
        result = calibrate(rig, wand, part, distance)
    except CalibrationError as error:
        return Trial(fault=str(error))
    except Exception as error:  # a wave that somebody took trouble over is not lost by a trial
        return Trial(fault=f"the trial solution failed ({type(error).__name__}: {error}); the wave goes on")
    trust, fewer = assess(result, wand), share**0.5
    delivering = {message.camera for message in part}
    return Trial(
        unplaced={name: why for name, why in trust.unplaced.items() if name in delivering},
        strain={c.name: fewer * c.noise_ratio for c in trust.cameras},
        used={c.name: 1 - c.figures["unused"] for c in trust.cameras},
        advice={c.name: c.wave_next for c in trust.cameras},
        expected_mm=trust.expected.typical_mm if trust.expected else None,
        grade=trust.grade,
    )
