# SPDX-License-Identifier: BSD-3-Clause
"""Two calibrations agree when they should, whatever worlds they are in, and the camera that moved is named."""

import msgspec
import numpy as np
import pytest
from scipy.stats import kstest

from calib.commands.check import split_halves
from calib.errors import CalibrationError
from calib.rig.rig import Rig
from calib.wand.calibrate import calibrate
from calib.wand.quality.agreement import CameraPoses, compare_calibrations
from camera_node.geometry.pose import Pose
from tests.calib.synthetic import CAREFUL, Arena, disturb, random_covariance, record, ring, roughly


@pytest.mark.parametrize("count", [2, 5])
def test_the_probability_is_one(count: int):
    """Of calibrations that differ as their covariances say, probabilities are uniform on [0, 1] (Kolmogorov and
    Smirnov, at 0.1 %)."""
    rng = np.random.default_rng(0)
    truth = np.array([c.matrix() for c in ring(count).truth.cameras.values()])
    names, told = [f"cam{k}" for k in range(count)], []
    for _ in range(150):
        found = []
        for _ in range(2):
            C = random_covariance(count, rng)
            found.append(
                CameraPoses(
                    names, disturb(truth, np.linalg.cholesky(C) @ rng.standard_normal(6 * count), rng), C
                )
            )
        told.append(compare_calibrations(*found))
    assert kstest([a.probability for a in told], "uniform").pvalue > 1e-3
    assert {a.degrees for a in told} == {6 * count - 6}


def test_a_camera_that_moved_is_named():
    """5 mm, where covariances say 1: the others agree without it, and what it moved by is told."""
    rng = np.random.default_rng(1)
    truth = np.array([c.matrix() for c in ring(5).truth.cameras.values()])
    C, off = 0.1 * random_covariance(5, rng), np.zeros(30)
    off[6 * 3 + 3] = 5e-3
    names = ["a", "b", "c", "d", "e"]
    told = compare_calibrations(
        CameraPoses(names, truth, C), CameraPoses(names[::-1], disturb(truth, off, rng)[::-1], C)
    )
    assert not told.holds
    assert told.moved == "d"
    assert told.probability_without > 1e-3
    assert told.shift_mm["d"] == pytest.approx(5, abs=0.5)
    assert "most in camera 'd', by 5." in told.sentence()
    assert "the others agree" in told.sentence()


def test_halves_of_a_wave_agree_and_a_knock_between_them_is_found():
    """The solver's own covariances: 10 s of a wave in halves; then one camera is knocked by 10 mm after 5 s. Lenses
    have figures: three cameras see in 5 s too little to tell them from such a knock."""
    arena = ring(3)
    messages, lenses = record(arena, 10.0, sigma_px=0.1), roughly(arena.intrinsics, CAREFUL, with_sigma=True)
    first, second = (
        CameraPoses.of_calibration(calibrate(lenses, arena.wand, half)) for half in split_halves(messages)
    )
    assert compare_calibrations(first, second).holds
    knocked = _knock(arena, "cam1", 0.01)
    late = [m for m in record(knocked, 10.0, sigma_px=0.1, seed=1) if m.t_ns > 5e9]
    told = compare_calibrations(first, CameraPoses.of_calibration(calibrate(lenses, arena.wand, late)))
    assert not told.holds
    assert told.moved == "cam1"


def _knock(arena: Arena, name: str, by: float) -> Arena:
    T = arena.truth.cameras[name].matrix()
    T[:3, 3] += [0.0, 0.0, by]
    moved = msgspec.structs.replace(arena.truth.cameras[name], T_world_cam=Pose.from_matrix(T))
    return Arena(Rig(cameras=arena.truth.cameras | {name: moved}), arena.wand)


def test_one_common_camera_can_not_be_compared():
    C = np.eye(6) * 1e-6
    with pytest.raises(CalibrationError, match=r"1 camera in common \(a\)"):
        compare_calibrations(CameraPoses(["a"], np.eye(4)[None], C), CameraPoses(["a"], np.eye(4)[None], C))
