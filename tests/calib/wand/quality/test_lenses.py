# SPDX-License-Identifier: BSD-3-Clause
"""A lens that differs from its file is adjusted, in every parameter, and the change is reported."""

from functools import cache

import msgspec
import numpy as np
import pytest

from calib.rig.camera import lens_parameters
from calib.rig.rig import Rig
from calib.wand.calibrate import calibrate
from calib.wand.quality.lenses import LensChange, find_lens_changes
from tests.calib.recordings import SimulatedRecording, WandScenario, record
from tests.calib.synthetic import assert_honest


@cache
def recorded(seed: int) -> SimulatedRecording:
    return record(WandScenario(cameras=5, seconds=12, rate_hz=30, seed=seed))


def change_of(name: str, rig: Rig, seed: int) -> LensChange:
    """Calibrate, require poses within their covariance, and return the change of a lens."""
    result = calibrate(rig, WandScenario().wand, recorded(seed).messages)
    assert set(result.rig.placed()) == set(rig.cameras)
    assert_honest([(result, recorded(seed).truth)])
    return find_lens_changes(result.names, result.adjusted)[name]


@pytest.mark.parametrize(
    ("index", "by", "number", "named"),
    [
        pytest.param(1, 8.0, 4, "fx / fy", marks=pytest.mark.ci),
        pytest.param(6, 0.004, 6, "p1", marks=pytest.mark.ci),
        (7, 0.004, 7, "p2"),
    ],
)
def test_a_lens_of_another_shape_is_adjusted_and_named(index: int, by: float, number: int, named: str):
    """A ratio of focal lengths 1 % off, or a tilted sensor: it moves pixels in the corner by 4."""
    rig = recorded(1).intrinsics
    true = rig.cameras["cam02"]
    parameters = true.parameters
    parameters[index] += by
    change = change_of("cam02", Rig(cameras={**rig.cameras, "cam02": true.with_parameters(parameters)}), 1)
    off = lens_parameters(change.after) - lens_parameters(true)
    assert abs(off[number]) < 4 * change.sigma[number]
    assert change.sigma[number] < 0.2 * abs(lens_parameters(change.before) - lens_parameters(true))[number]
    assert f", {named} " in change.sentence()


@pytest.mark.parametrize(
    "factor",
    [
        pytest.param(0.85, marks=pytest.mark.ci),
        pytest.param(1.1, marks=pytest.mark.slow),
        pytest.param(1.2, marks=pytest.mark.ci),
    ],
)
def test_a_lens_known_from_a_data_sheet_or_another_camera_is_adjusted(factor: float):
    """Focal lengths of data sheets are 9 % off and more. The camera stays, with its focal length right to 4 sigmas."""
    rig = recorded(1).intrinsics
    true = rig.cameras["cam02"]
    wrong = msgspec.structs.replace(true, fx=factor * true.fx, fy=factor * true.fy)
    change = change_of("cam02", Rig(cameras={**rig.cameras, "cam02": wrong}), 1)
    assert abs(np.log(change.after.fx / true.fx)) < 4 * change.sigma[0]
    assert change.sigma[0] < 0.01
