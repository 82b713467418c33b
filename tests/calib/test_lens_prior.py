# SPDX-License-Identifier: BSD-3-Clause
"""Rigs from lenses that are only roughly known: what is claimed of them is true, and the lens is named."""

import msgspec
import numpy as np
import pytest
from scipy.stats import chi2

from calib.lens_prior import told_sigma, usual_sigma
from calib.rig import Rig
from calib.trust import assess
from calib.wand import calibrate
from tests.calib.synthetic import joint_error
from tests.calib.wave import Recorded, Wave, record

SEEDS = (1, 3)


def rough(recorded: Recorded, focal: float, seed: int) -> Rig:
    """The rig before, focal lengths off by `focal` (1 sigma, uniform), without figures."""
    rng, cameras = np.random.default_rng(seed), {}
    for name, camera in recorded.intrinsics.cameras.items():
        factor = np.exp(focal * np.sqrt(3) * rng.uniform(-1, 1))
        cameras[name] = msgspec.structs.replace(
            camera, fx=factor * camera.fx, fy=factor * camera.fy, lens_sigma=None
        )
    return Rig(cameras=cameras)


@pytest.mark.parametrize("focal", [0.004, 0.03])
def test_rigs_from_rough_lenses_claim_what_is_true(focal: float):
    """Squared Mahalanobis errors of all poses, over waves, stay below the 99.9 % quantile of chi-square. They may be
    small, as the doubt in a lens is the upper end of an interval; a third of the mean would be timid. With lenses taken
    for exact they were 300 to 5,000 times the mean."""
    squared, degrees = 0.0, 0
    for seed in SEEDS:
        wave = Wave(cameras=5, seconds=10, rate_hz=30, both_sides=True, seed=seed)
        recorded = record(wave)
        result = calibrate(rough(recorded, focal, seed), wave.wand, recorded.messages)
        assert len(result.names) == 5
        more, count = joint_error(result, recorded.truth)
        squared, degrees = squared + more, degrees + count
    assert degrees / 3 < squared < chi2.ppf(0.999, degrees)


def test_the_lens_is_named_where_it_spoils_the_rig():
    """Four cameras, twelve seconds, focal lengths 2 % off: places are known to centimetres, and the report says why."""
    wave = Wave(cameras=4, seconds=12, rate_hz=30, seed=1)
    recorded = record(wave)
    trust = assess(calibrate(rough(recorded, 0.02, 1), wave.wand, recorded.messages), wave.wand)
    assert trust.grade > "A"
    assert trust.spoilt()
    assert "known too roughly" in trust.spoilt()[0]


def test_figures_hold_where_they_stand_and_the_usual_where_none_do():
    camera = record(Wave(cameras=2, seconds=0.1)).truth.cameras["cam00"]
    told = told_sigma(camera)
    assert told is not None
    assert told[0] == pytest.approx(0.5 / camera.fx, rel=0.01)
    assert told_sigma(msgspec.structs.replace(camera, lens_sigma=None)) is None
    assert usual_sigma(camera)[0] == 0.03
    with pytest.raises(ValueError, match="lens_sigma"):
        type(camera)(width=8, height=8, fx=8.0, fy=8.0, cx=4.0, cy=4.0, lens_sigma=(0.1,))
