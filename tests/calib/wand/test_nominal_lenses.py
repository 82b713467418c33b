# SPDX-License-Identifier: BSD-3-Clause
"""Cameras without lens calibration: the wand finds lenses and poses from nominal lenses."""

import math

import msgspec
import numpy as np
import pytest
from scipy.stats import chi2

from calib.rig.rig import Rig
from calib.wand.calibrate import calibrate
from calib.wand.focal_lengths import GRID, with_rough_focal_lengths
from calib.wand.nominal_lens import nominal_lens, with_nominal_lenses
from calib.wand.quality.grade import assess
from camera_node.geometry.body import Body
from tests.benchmarks.calibration_honesty import field_of_view, focal_error, without_lenses
from tests.calib.recordings import WandScenario
from tests.calib.recordings import record as record_scenario
from tests.calib.synthetic import Arena, errors, joint_error, record, ring


@pytest.mark.parametrize(("width", "height"), [(640, 480), (1920, 1080)])
def test_the_nominal_lens_has_sixty_degrees(width: int, height: int):
    """Between the rays of the outermost pixels' outer edges; square pixels, the centre in the middle."""
    lens = nominal_lens(width, height)
    edges = (np.array([-0.5, width - 0.5]) - lens.cx) / lens.fx
    assert np.degrees(np.arctan(edges)) == pytest.approx([-30, 30])
    assert lens.fx == lens.fy
    assert (2 * lens.cx, 2 * lens.cy) == (width - 1, height - 1)


def test_known_lenses_stay():
    """Only cameras that the rig lacks get a nominal lens."""
    known = Rig(cameras={"a": nominal_lens(320, 240)}, calibration={"grade": "A"})
    completed, missing = with_nominal_lenses(known, {"a": (640, 480), "b": (640, 480)})
    assert missing == ["b"]
    assert completed.cameras["a"] == known.cameras["a"]
    assert completed.calibration == known.calibration


def with_field_of_view(arena: Arena, degrees: float) -> Arena:
    """The arena with other focal lengths; the cameras differ by 10 px, as in `ring`."""
    focal = 400 / math.tan(math.radians(degrees / 2))
    cameras = {
        name: msgspec.structs.replace(camera, fx=focal + 10 * k, fy=focal + 10 * k + 2)
        for k, (name, camera) in enumerate(arena.truth.cameras.items())
    }
    return Arena(Rig(cameras=cameras))


@pytest.mark.ci
@pytest.mark.parametrize(
    "degrees", [*(pytest.param(degrees, marks=pytest.mark.slow) for degrees in (50.0, 60.0)), 70.0]
)
def test_the_wand_finds_lenses_from_fifty_to_seventy_degrees(degrees: float):
    """20 s of 0.1 px. The focal lengths come within 0.5 %; poses within 5 mm, 0.2 % of the distance to the wand."""
    arena = with_field_of_view(ring(), degrees)
    messages = record(arena, 20.0, sigma_px=0.1)
    rig, missing = with_nominal_lenses(Rig(cameras={}), {m.camera: (m.width, m.height) for m in messages})
    assert missing == sorted(arena.truth.cameras)
    result = calibrate(rig, arena.wand, messages)
    found = result.rig
    ratios = [found.cameras[name].fx / camera.fx for name, camera in arena.truth.cameras.items()]
    assert np.allclose(ratios, 1.0, atol=5e-3)
    assert errors(found, arena.truth)[0] < 5e-3
    assert assess(result, arena.wand).open_lenses == {}


def test_rough_focal_lengths_are_found_between_half_and_twice_the_guess():
    """Cameras without distortion and noise, each guess wrong by another factor: within a step of the grid. The lens
    that is known stays."""
    truth = {
        name: msgspec.structs.replace(camera, distortion=()) for name, camera in ring().truth.cameras.items()
    }
    arena = Arena(Rig(cameras=truth))
    messages = record(arena, 20.0, numbered=True, sized=False, free_running=False)
    given, factors = dict(arena.intrinsics.cameras), {"cam0": 0.5, "cam1": 0.8, "cam2": 2.0}
    for name, factor in factors.items():
        lens = truth[name]
        given[name] = nominal_lens(lens.width, lens.height, field_of_view(lens.width, factor * lens.fx))
    found = with_rough_focal_lengths(Rig(cameras=given), arena.wand, messages).cameras
    assert found["cam3"] == given["cam3"]
    ratios = [found[name].fx / truth[name].fx for name in factors]
    step = 4 * math.log(2) / math.sqrt(3) / (GRID - 1)
    assert np.abs(np.log(ratios)).max() < step


def test_a_focal_length_that_is_not_determined_is_called_so():
    """Two cameras and a light: the 95 % intervals are wide, contain the truth, and are in the sentence, which the page
    and the command show, and in the file."""
    light = Body(diameter_m=0.05)
    scenario = WandScenario(
        cameras=2, wand=light, seconds=8, rate_hz=20, sigma_px=0.2, numbered=True, sized=False, both_sides=True,
        offset_ms=0, drift_ppm=0, free_running=False, seed=2,
    )  # fmt: skip
    recorded = record_scenario(scenario)
    result = calibrate(without_lenses(recorded.intrinsics, 2), light, recorded.messages)
    quality = assess(result, light)
    assert set(quality.open_lenses) == set(recorded.truth.cameras)
    for name, (low, high) in quality.open_lenses.items():
        assert low < recorded.truth.cameras[name].fx < high
        assert high / low > 1.1
        assert f"of '{name}' between {low:.0f} and {high:.0f} px" in quality.as_dict()["because"]
        sigma = result.rig.cameras[name].lens_sigma
        assert sigma is not None
        assert sigma[0] == pytest.approx(result.rig.cameras[name].fx * np.log(high / low) / 3.92, rel=0.01)


@pytest.mark.slow
def test_claims_hold_of_lenses_that_are_unknown_by_a_factor_of_two():
    """A light and four free-running cameras: the weakest recording. The summed squared errors of poses, and of focal
    lengths, are below the 99.9 % quantile of chi-square."""
    poses, focal, degrees, count = 0.0, 0.0, 0, 0
    wand = msgspec.structs.replace(WandScenario().wand, markers=((0.0, 0.0, 0.0),))
    for seed in (1, 2):
        scenario = WandScenario(
            cameras=4, wand=wand, seconds=20, rate_hz=20, sigma_px=0.2, numbered=True, sized=False,
            both_sides=True, offset_ms=50, drift_ppm=0, outliers=0.02, seed=seed,
        )  # fmt: skip
        recorded = record_scenario(scenario)
        result = calibrate(without_lenses(recorded.intrinsics, seed), wand, recorded.messages)
        squared, more = joint_error(result, recorded.truth)
        poses, degrees = poses + squared, degrees + more
        focal, count = (
            focal + len(result.names) * focal_error(result, recorded.truth),
            count + len(result.names),
        )
    assert poses < chi2.ppf(0.999, degrees)
    assert focal < chi2.ppf(0.999, count)
