# SPDX-License-Identifier: BSD-3-Clause
"""The velocities of a keyframe's robots are within what is claimed of them, for gentle and for hard accelerations."""

import numpy as np
import pytest

from fusion.model.frames import FrameSet
from fusion.model.observations import CameraArray, MarkerTable
from fusion.model.states import Snapshot, States
from fusion.rig_graph.keyframes import Keyframes, velocity_sigma
from tests.benchmarks.fusion_load import START_NS, Load

LOAD = Load(robots=4, cameras=3)
STEP_NS, KEYFRAMES = 10_000_000, 24
SIGMA_M, SIGMA_RAD = 3e-4, 5e-3  # of a tracked pose, independent from each other: the filter's are correlated


@pytest.mark.parametrize("density", [0.0, 0.05, 5.0])
def test_velocities_are_within_their_claims(density: float):
    """Positions are integrals of white acceleration; 0 is a constant velocity."""
    rng = np.random.default_rng(3)
    keyframes = Keyframes(CameraArray(LOAD.rig), MarkerTable.of(list(LOAD.bodies.values())), KEYFRAMES)
    n, dt = LOAD.robots, STEP_NS * 1e-9
    p, v = np.zeros((n, 3)), rng.normal(size=(n, 3))
    at_rest = States.at_rest(np.tile(np.eye(3), (n, 1, 1)), p, (SIGMA_RAD, SIGMA_M, 1.0, 1.0))
    true: dict[int, np.ndarray] = {}
    k = 0
    while len(keyframes.kept) < KEYFRAMES:
        t_ns, k = START_NS + k * STEP_NS, k + 1
        noise = rng.normal(size=(2, n, 3))
        step = np.sqrt(density * dt) * noise[0]
        p, v = p + dt * (v + step / 2) + np.sqrt(density / 12) * dt**1.5 * noise[1], v + step
        true[t_ns] = v
        states = States(at_rest.R, p + SIGMA_M * rng.normal(size=(n, 3)), 0 * p, 0 * p, at_rest.P)
        keyframes.add(FrameSet(t_ns, ()), Snapshot(t_ns, states, np.ones(n, bool)))
    robots = np.concatenate([keyframe.robots for keyframe in keyframes.kept])
    error = np.concatenate([keyframe.states.v - true[keyframe.t_ns] for keyframe in keyframes.kept])
    sigma = velocity_sigma(keyframes.kept, robots)[:, 1]
    squared = float(np.mean((error / sigma[:, None]) ** 2))
    # The standard deviation of the mean of 288 squares is 0.08. The larger of two estimates claims more than the error,
    # but not twice as much.
    assert 1 / 4 < squared < 1.25
