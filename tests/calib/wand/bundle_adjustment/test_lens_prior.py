# SPDX-License-Identifier: BSD-3-Clause
"""Rigs from lenses that are only roughly known: what is claimed of them is true, and the lens is named."""

from functools import cache

import msgspec
import numpy as np
import pytest
from scipy.stats import chi2

from calib.rig.rig import Rig
from calib.wand.bundle_adjustment.lens_prior import calibrated_sigma
from calib.wand.calibrate import calibrate
from calib.wand.outcome import WandCalibration
from calib.wand.quality.grade import assess
from calib.wand.recalibration import place_one
from tests.calib.synthetic import CAREFUL, EXACT, OLD, SHEET, camera_errors, joint_error, roughly
from tests.calib.wave import Recorded, Wave, record

SEEDS = (1, 2)


@cache
def recorded(seed: int) -> Recorded:
    return record(Wave(cameras=6, seconds=12, rate_hz=30, seed=seed))


def placed(seed: int, off: tuple[float, float, float], told: bool) -> WandCalibration:
    result = calibrate(
        roughly(recorded(seed).intrinsics, off, told, seed), Wave().wand, recorded(seed).messages
    )
    assert len(result.names) == 6
    return result


@pytest.mark.parametrize(("off", "told"), [(CAREFUL, True), (OLD, False), (SHEET, False)])
def test_rigs_from_rough_lenses_claim_what_is_true(off: tuple[float, float, float], told: bool):
    """Squared Mahalanobis errors of all poses, summed over waves, lie between the 0.1 % and 99.9 % quantiles of
    chi-square. With lenses taken for exact they were 300 to 5,000 times the mean."""
    squared, degrees = np.sum(
        [joint_error(placed(seed, off, told), recorded(seed).truth) for seed in SEEDS], axis=0
    )
    assert chi2.ppf(0.001, degrees) < squared < chi2.ppf(0.999, degrees)


def test_exact_lenses_lose_little():
    """Nothing tells a lens that is exact from one that is off by less than a wave can see: covariances cover that, so
    squared errors may be small, but not large, and places are as good as with lenses that are known."""
    for seed in SEEDS:
        result = placed(seed, EXACT, told=False)
        assert joint_error(result, recorded(seed).truth)[0] < chi2.ppf(0.999, 30)
        assert camera_errors(result.rig, recorded(seed).truth)[0].max() < 2e-3


def test_the_lens_is_named_where_it_spoils_the_rig():
    """Four cameras, twelve seconds, focal lengths 2 % off: places are known to centimetres, and the report says why."""
    wave = Wave(cameras=4, seconds=12, rate_hz=30, seed=1)
    recorded = record(wave)
    trust = assess(calibrate(roughly(recorded.intrinsics, SHEET), wave.wand, recorded.messages), wave.wand)
    assert trust.grade > "A"
    assert trust.spoilt()
    assert "known too roughly" in trust.spoilt()[0]


def test_figures_that_a_wave_contradicts_do_not_count():
    """A focal length 2 % off that claims 0.06 %: found to 0.6 %, three times what this wave leaves open."""
    rig, truth = roughly(recorded(2).intrinsics, CAREFUL, told=True), recorded(2).truth
    wrong = rig.cameras["cam02"]
    wrong = msgspec.structs.replace(wrong, fx=1.02 * wrong.fx, fy=1.02 * wrong.fy)
    result = calibrate(Rig(cameras={**rig.cameras, "cam02": wrong}), Wave().wand, recorded(2).messages)
    assert result.rig.cameras["cam02"].fx == pytest.approx(truth.cameras["cam02"].fx, rel=0.006)
    sigma = result.adjusted.problem.lens_sigma[:, 0]
    assert sigma[2] > 0.005
    assert np.delete(sigma, 2) == pytest.approx(CAREFUL[0], rel=0.05)  # times f as it is off


@pytest.mark.parametrize("off", [OLD, SHEET])
def test_one_camera_is_placed_through_a_rough_lens_as_well_as_claimed(off: tuple[float, float, float]):
    """The squared Mahalanobis errors of the pose, over waves, are below the 99.9 % quantile of chi-square."""
    squared = 0.0
    for seed in SEEDS:
        truth, rough = (
            recorded(seed).truth,
            roughly(recorded(seed).intrinsics, off, seed=seed).cameras["cam02"],
        )
        rig = Rig(cameras={**truth.cameras, "cam02": rough})
        here = place_one(rig, Wave().wand, recorded(seed).messages, "cam02").rig.cameras["cam02"]
        D = np.linalg.inv(here.matrix()) @ truth.cameras["cam02"].matrix()
        error = np.array([D[2, 1], D[0, 2], D[1, 0], *D[:3, 3]])
        squared += error @ np.linalg.solve(np.array(here.covariance), error)
    assert squared < chi2.ppf(0.999, 6 * len(SEEDS))


def test_figures_that_stand_with_a_lens_are_read_and_checked():
    camera = roughly(recorded(1).intrinsics, CAREFUL, told=True).cameras["cam00"]
    assert calibrated_sigma(camera) == pytest.approx([6e-4, 0.5, 0.5, 5e-4], rel=0.01)
    assert calibrated_sigma(msgspec.structs.replace(camera, lens_sigma=None)) is None
    with pytest.raises(ValueError, match="lens_sigma"):
        type(camera)(width=8, height=8, fx=8.0, fy=8.0, cx=4.0, cy=4.0, lens_sigma=(0.1,))
