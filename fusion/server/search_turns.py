# SPDX-License-Identifier: BSD-3-Clause
"""Decides in which frame sets missing robots are searched for."""

from dataclasses import replace

from fusion.model.frames import FrameSet

MAX_UNSEARCHED_NS = 1_000_000_000  # a server that always lags searches for missing robots once a second


class SearchTurns:
    """Missing robots are searched for in frame sets behind which no others wait.

    A search may last as long as many frame sets. Those that wait are tracked without one first, so that robots that
    were just found are not lost.
    """

    def __init__(self) -> None:
        self._last_ns = 0  # time of the last frame set with a search

    def decide(self, frame_set: FrameSet, is_late: bool) -> FrameSet:
        """The next frame set, with or without a search; `is_late`: whether others wait."""
        is_searched = not is_late or abs(frame_set.t_ns - self._last_ns) > MAX_UNSEARCHED_NS
        if is_searched:
            self._last_ns = frame_set.t_ns
        return replace(frame_set, is_searched=is_searched)
