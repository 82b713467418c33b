# SPDX-License-Identifier: BSD-3-Clause
"""Suggested places of cameras."""

import time

import numpy as np
import pytest

from calib.plan import placement
from calib.plan.camera_kind import CameraKind
from calib.plan.description import Mount, Plan, PlannedRobots, Suggestion
from calib.plan.placement import (
    BLIND_M,
    PlacementProblem,
    evaluate_placement,
    mean_error,
    suggest_placement,
)

KIND = CameraKind(model="ov9281")
ROBOTS = PlannedRobots(diameter_m=0.12, heights_m=(0.1, 0.1))
PLAN = Plan(
    area_m=(-2.0, -2.0, 2.0, 2.0),
    robots=ROBOTS,
    suggest=Suggestion(camera=KIND, mounts={"wall": Mount(from_m=(-2.0, 2.0, 2.5), to_m=(2.0, 2.0, 2.5))}),
)


def test_the_objective_is_the_error_of_the_posterior():
    """Without a view the prior's error; with isotropic information the closed form; with a full matrix its inverse."""
    assert mean_error(np.zeros((4, 6))) == pytest.approx(np.sqrt(3) * BLIND_M)
    information = np.array([[1e6, 0, 0, 1e6, 0, 1e6]])
    assert mean_error(information) == pytest.approx(np.sqrt(3 / (1e6 + BLIND_M**-2)))
    M = np.random.default_rng(1).standard_normal((3, 3))
    A = 1e4 * M @ M.T
    inverse = np.linalg.inv(A + np.eye(3) / BLIND_M**2)
    assert mean_error(A[None, *np.triu_indices(3)]) == pytest.approx(np.sqrt(np.trace(inverse)))


def test_suggested_cameras_hang_on_their_mount_and_beat_even_spacing(monkeypatch: pytest.MonkeyPatch):
    """Three cameras on one wall, with a smaller search than the command's."""
    for name, value in {"PLACES": 8, "AIMS": 3, "STARTS": 2}.items():
        monkeypatch.setattr(placement, name, value)
    problem, shares = PlacementProblem(PLAN, KIND), []
    suggested = suggest_placement(problem, 3, shares.append)
    even = np.array([[x, 2.0, 2.5] for x in (-1.0, 0.0, 1.0)])
    plain = evaluate_placement(problem, even, np.tile([0.0, 0.0, 0.1], (3, 1)))
    assert suggested.cost_m < plain.cost_m
    assert (suggested.positions_m[:, 1:] == [2.0, 2.5]).all()
    assert (np.abs(suggested.positions_m[:, 0]) <= 2).all()
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1.0)
    again = evaluate_placement(problem, suggested.positions_m, suggested.aims_m)
    assert again.cost_m == pytest.approx(suggested.cost_m, rel=1e-9)


def test_without_mounts_cameras_hang_along_the_ceiling():
    plan = Plan(area_m=(-1.0, -1.0, 1.0, 1.0), room_m=(-2.0, -2.0, 2.0, 2.0), ceiling_m=2.8, robots=ROBOTS)
    for mount in plan.mounts():
        low, high = mount.corners
        assert (low[2], high[2]) == (2.8, 2.8)
        assert np.count_nonzero(high > low) == 1


@pytest.mark.slow
def test_eight_suggested_cameras_beat_the_ring_of_eight():
    """In 6 x 6 x 3 m, with the command's search, in less than a minute of one core."""
    plan = Plan(area_m=(-3.0, -3.0, 3.0, 3.0), robots=PlannedRobots(diameter_m=0.12, heights_m=(0.1, 1.5)))
    problem = PlacementProblem(plan, KIND)
    corners = np.array([(x, y, 3.0) for x in (-3, 0, 3) for y in (-3, 0, 3) if (x, y) != (0, 0)], float)
    ring = evaluate_placement(problem, corners, np.tile([0.0, 0.0, 0.8], (8, 1)))
    start = time.process_time()
    suggested = suggest_placement(problem, 8)
    assert time.process_time() - start < 60
    assert suggested.cost_m < ring.cost_m
