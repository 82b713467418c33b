# SPDX-License-Identifier: BSD-3-Clause
"""Runs a wand session: collects frames from running cameras until the calibration is precise enough.

Every few seconds, a trial calibration (`trials`) predicts the result of all frames. The session ends when

- every camera that sends frames is placed,
- no camera's own covariance adds more than 5 % to the error of a roundel's pixel, and
- the wand was seen in half of the image area that each camera shares with others, or in no new area for 15 s;

or when no roundel moves for 15 s: the wand was put down or carried away. While a camera is not placed, the session
waits for the wand to return.
"""

import threading
from collections.abc import Callable

import zenoh

from calib.live.collect import CollectedFrames, collect_frames
from calib.live.session_progress import GONE_S, SessionProgress, StoppingRule, is_wand_gone, summarize
from calib.live.trials import TrialSolver, WandSession


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
