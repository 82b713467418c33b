# SPDX-License-Identifier: BSD-3-Clause
"""A fixture that tracks the frames of a synthetic arena."""

from collections.abc import Callable

import pytest

from fusion.model.limits import Limits
from fusion.protocol.pose_messages import RobotPose
from fusion.tracking.result import TrackingResult
from tests.fusion.synthetic import Arena
from tests.fusion.tracks import poses_of, track


@pytest.fixture
def run_arena() -> Callable[..., tuple[list[TrackingResult], Callable[[str], list[RobotPose]]]]:
    """`run_arena(arena, n)`: the results of n frames per camera, and a function from a robot to its poses."""

    def run(arena: Arena, n: int = 30, limits: Limits | None = None):
        results = track(arena, arena.frames(n), limits)
        return results, lambda robot: poses_of(results, robot)

    return run
