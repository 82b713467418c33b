# SPDX-License-Identifier: BSD-3-Clause
"""The comparison of two calibrations: independent of the world frame, calibrated, and it names a camera that moved."""

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
def test_probabilities_are_uniform(count: int):
    """The probabilities of calibrations whose differences follow their covariances are uniform on [0, 1] (Kolmogorov
    and Smirnov, at 0.1 %)."""
    rng = np.random.default_rng(0)
    truth = np.array([c.matrix() for c in ring(count).truth.cameras.values()])
    names, agreements = [f"cam{k}" for k in range(count)], []
    for _ in range(150):
        found = []
        for _ in range(2):
            C = random_covariance(count, rng)
            off = np.linalg.cholesky(C) @ rng.standard_normal(6 * count)
            found.append(CameraPoses(names, disturb(truth, off, rng), C))
        agreements.append(compare_calibrations(*found))
    assert kstest([agreement.probability for agreement in agreements], "uniform").pvalue > 1e-3
    assert {agreement.degrees for agreement in agreements} == {6 * count - 6}


def test_a_camera_that_moved_is_named():
    """By 5 mm, with standard deviations below 1 mm: the others agree, and the shift is reported."""
    rng = np.random.default_rng(1)
    truth = np.array([c.matrix() for c in ring(5).truth.cameras.values()])
    C, off = 0.1 * random_covariance(5, rng), np.zeros(30)
    off[6 * 3 + 3] = 5e-3
    names = ["a", "b", "c", "d", "e"]
    second = CameraPoses(names[::-1], disturb(truth, off, rng)[::-1], C)
    agreement = compare_calibrations(CameraPoses(names, truth, C), second)
    assert not agreement.holds
    assert agreement.moved == "d"
    assert agreement.probability_without > 1e-3
    assert agreement.shift_mm["d"] == pytest.approx(5, abs=0.5)
    for fact in ("camera 'd'", f"{agreement.shift_mm['d']:.1f} mm", f"{agreement.chi2:.0f}"):
        assert fact in agreement.sentence()


def test_halves_of_a_recording_agree_until_a_camera_moves():
    """With the covariances of the adjustment: two halves of 10 s agree; then one camera moves by 10 mm after 5 s. The
    lenses state standard deviations: three cameras do not distinguish their errors from such a motion in 5 s."""
    arena = ring(3)
    messages, lenses = record(arena, 10.0, sigma_px=0.1), roughly(arena.intrinsics, CAREFUL, with_sigma=True)
    first, second = (
        CameraPoses.of_calibration(calibrate(lenses, arena.wand, half)) for half in split_halves(messages)
    )
    assert compare_calibrations(first, second).holds
    moved = _move(arena, "cam1", 0.01)
    late = [m for m in record(moved, 10.0, sigma_px=0.1, seed=1) if m.t_ns > 5e9]
    third = CameraPoses.of_calibration(calibrate(lenses, arena.wand, late))
    agreement = compare_calibrations(first, third)
    assert not agreement.holds
    assert agreement.moved == "cam1"


def _move(arena: Arena, name: str, by: float) -> Arena:
    T = arena.truth.cameras[name].matrix()
    T[:3, 3] += [0.0, 0.0, by]
    moved = msgspec.structs.replace(arena.truth.cameras[name], T_world_cam=Pose.from_matrix(T))
    return Arena(Rig(cameras=arena.truth.cameras | {name: moved}), arena.wand)


def test_one_common_camera_is_not_compared():
    poses = CameraPoses(["a"], np.eye(4)[None], np.eye(6) * 1e-6)
    with pytest.raises(CalibrationError, match=r"1 camera .*\(a\)"):
        compare_calibrations(poses, poses)
