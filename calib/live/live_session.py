# SPDX-License-Identifier: BSD-3-Clause
"""Runs a wand session: collects frames from running cameras until the calibration is precise enough.

Every few seconds, a trial calibration (`trials`) predicts the result of all frames. The session ends when

- every camera that sends frames is placed,
- no camera's own covariance adds more than 5 % to the error of a roundel's pixel, and
- the wand was seen in half of the image area that each camera shares with others, or in no new area for 15 s;

or when no roundel moves for 15 s: the wand was put down or carried away. While a camera is not placed, the session
waits for the wand to return. Its progress says what was seen, and where to wave next.
"""

import threading
from collections.abc import Callable
from dataclasses import dataclass

import zenoh

from calib.live.collect import CollectedFrames, collect_frames
from calib.live.trials import Trial, TrialSolver, WandSession

MAX_ADDED_ERROR = 0.05  # that a camera's covariance may add to the error of a pixel, as a fraction of it
MIN_USED = 0.5  # of the image area that a camera shares with others
MIN_GROWTH = 0.01  # of the used area, summed over cameras: less counts as none
GONE_S = 15.0  # without a roundel that moves: the wand is gone; or without growth of the used area
PAUSE_S = 3.0  # without a roundel that moves: the progress line reports it


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
        """The elapsed time, and the result of the latest trial, which may be that of much earlier frames."""
        if self.trial is None:
            return f"{self.seconds:.0f} s"
        part, expected_mm = (
            f"{self.seconds:.0f} s; the first {self.trial.until_s:.0f} s",
            self.trial.expected_mm,
        )
        if expected_mm is None:
            return part
        return f"{part} give grade {self.trial.grade}, expected error {expected_mm:.1f} mm"

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
        return precise and (min(trial.used.values()) >= MIN_USED or now_s - self.grew_s > GONE_S)


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
    if trial is not None:
        return _advise_by(trial)
    return "wave the wand where two cameras or more see it; no result is computed yet"


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
    with TrialSolver(settings) as solver:

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
