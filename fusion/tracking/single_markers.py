# SPDX-License-Identifier: BSD-3-Clause
"""Chooses the unlabeled markers that are missing robots with a single marker: by start, size and motion.

Any marker of its size within reach of where a robot started or was lost may be the robot. Markers that move together
belong to one body and are left out. Of several others whose motions are known, the one that moved alone is the robot.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from camera_node.foundation.arrays import Index, Mask
from fusion.tracking.gating import DIAMETER_TOLERANCE, POSITION_GATE
from fusion.tracking.rays import Marker, MarkerHistories
from fusion.tracking.track_table import TrackTable

WATCHED_S = 0.3  # a marker of a robot that may be anywhere must have been tracked for this time, or move

Histories = Callable[[Sequence[Marker]], MarkerHistories]


@dataclass(frozen=True, slots=True)
class MarkerChoice:
    """The marker (an index) of each robot (a row) that has one, and why the other robots have none."""

    pairs: dict[int, int]
    reasons: dict[int, str]


@dataclass(frozen=True, slots=True, eq=False)
class _Reach:
    """(R, M) which of M markers have the size of the robots, are near them, and may be them."""

    sized: Mask
    near: Mask
    chosen: Mask


def choose_markers(
    table: TrackTable, missing: Index, markers: list[Marker], histories: Histories
) -> MarkerChoice:
    """Choose markers for the missing single-marker robots: each the only one for the other."""
    choice = MarkerChoice({}, {})
    if not len(missing):
        return choice
    history = histories(markers)
    reach = _reach(table, missing, markers, history)
    for row, k in enumerate(missing.tolist()):
        options = np.flatnonzero(reach.chosen[row])
        others = np.flatnonzero(reach.chosen[:, options[0]]) if len(options) == 1 else np.empty(0, np.intp)
        if len(others) == 1 and (table.is_local(k) or _is_watched(history, options[0])):
            choice.pairs[k] = int(options[0])
        else:
            rivals = [table.names[missing[r]] for r in others if r != row]
            choice.reasons[k] = _reason(reach, row, rivals)
    return choice


def _reach(table: TrackTable, missing: Index, markers: list[Marker], history: MarkerHistories) -> _Reach:
    shape = len(missing), len(markers)
    sized = [[_has_size(table, k, marker) for marker in markers] for k in missing.tolist()]
    near = [[_is_near(table, k, marker) for marker in markers] for k in missing.tolist()]
    sized, near = np.array(sized, bool).reshape(shape), np.array(near, bool).reshape(shape)
    within = sized & near & ~history.moves_with_others
    alone = within & history.alone
    is_known = (alone.sum(1) == 1) & ~(within & ~history.anchored).any(1)
    return _Reach(sized, near, np.where(is_known[:, None], alone, within))


def _has_size(table: TrackTable, k: int, marker: Marker) -> bool:
    """Whether a marker has the size of robot k; True where its size is unknown."""
    return not abs(marker.diameter_m / table.robots[k].diameter_m - 1) >= DIAMETER_TOLERANCE


def _is_near(table: TrackTable, k: int, marker: Marker) -> bool:
    return table.history_chi2(k, marker.position, marker.covariance) < POSITION_GATE


def _is_watched(history: MarkerHistories, marker: int) -> bool:
    return bool(history.alone[marker] or history.age_s[marker] > WATCHED_S)


def _reason(reach: _Reach, row: int, rivals: list[str]) -> str:
    """Why the robot of a row has no marker."""
    sized, near, chosen = reach.sized[row], reach.near[row], reach.chosen[row]
    if not sized.any():
        return "no unlabeled marker of its size is seen by two cameras"
    if not (sized & near).any():
        return "no marker of its size is near its start or its last position"
    if not chosen.any():
        return "the markers of its size near it move together: they belong to another body"
    if chosen.sum() > 1:
        return f"{int(chosen.sum())} markers of its size may be it: move it alone, or give its start_m"
    return f"ambiguous with {', '.join(rivals)}" if rivals else "a marker of its size was seen just now"
