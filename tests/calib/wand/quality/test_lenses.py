# SPDX-License-Identifier: BSD-3-Clause
"""A wrong lens parameter that the adjustment takes as known is reported with the camera's name."""

from functools import cache

import pytest

from calib.rig.rig import Rig
from calib.wand.calibrate import calibrate
from calib.wand.quality.lenses import Misfit, find_misfit
from tests.calib.recordings import SimulatedRecording, WandScenario, record
from tests.calib.synthetic import CAREFUL, OLD, roughly


@cache
def recorded(seed: int) -> SimulatedRecording:
    return record(WandScenario(cameras=5, seconds=12, rate_hz=30, seed=seed))


def misfit(rig: Rig, seed: int) -> Misfit | None:
    result = calibrate(rig, WandScenario().wand, recorded(seed).messages)
    return find_misfit(result.names, result.adjusted, result.observations)


@pytest.mark.parametrize(("off", "with_sigma"), [(CAREFUL, True), (OLD, False)])
@pytest.mark.parametrize("seed", [1, 2])
def test_lenses_that_the_adjustment_corrects_are_not_named(
    off: tuple[float, float, float], with_sigma: bool, seed: int
):
    assert misfit(roughly(recorded(seed).intrinsics, off, with_sigma, seed), seed) is None


@pytest.mark.parametrize(("index", "by", "named"), [(1, 8.0, "fx / fy"), (6, 0.004, "p1"), (7, 0.004, "p2")])
def test_a_lens_of_another_shape_is_named(index: int, by: float, named: str):
    """A ratio of focal lengths 1 % off, or a tilted sensor: it moves pixels in the corner by 4."""
    rig, seed = recorded(1).intrinsics, 1
    true = rig.cameras["cam02"]
    parameters = true.parameters
    parameters[index] += by
    cameras = {**rig.cameras, "cam02": true.with_parameters(parameters)}
    found = misfit(Rig(cameras=cameras), seed)
    assert found is not None
    assert (found.camera, found.parameter) == ("cam02", named)
    right = true.fx / true.fy if index == 1 else true.parameters[index]
    assert found.estimate == pytest.approx(right, abs=5 * found.sigma + 0.3 * abs(found.given - right))
    assert "run python -m calib intrinsics --camera cam02" in found.sentence()
