# SPDX-License-Identifier: BSD-3-Clause
"""Rigs whose errors are larger than they state, or that state none: claims grow to what the robots show."""

import numpy as np
import pytest
from scipy.stats import chi2

from fusion.rig_graph.hypotheses import Verdict
from fusion.rig_graph.rig_monitor import next_scales
from tests.benchmarks.fusion_load import Load
from tests.fusion.clock_faults import Outcome, fuse, inaccurate, seconds
from tests.fusion.rig_graph.fits import fitted

LOAD = Load(robots=3, cameras=4, hz=30.0, speed_m_s=0.7, crossing=True)
BEGUN_S = 1.5  # six keyframes, and three judgements


def squared(outcome: Outcome) -> np.ndarray:
    """Squared errors of tracked positions over their claims; chi-square with three degrees where these are true."""
    rows = zip(outcome.poses, outcome.sigmas, strict=True)
    return np.array([s**2 for p, s in rows if seconds(p.t_ns) > BEGUN_S and p.state == "tracked"])


@pytest.mark.ci
def test_a_rig_that_states_no_errors_is_learnt():
    """Errors of one rig are the same in all poses: half of these lie within what nine of ten rigs do not exceed."""
    outcome = fuse(LOAD, 3.5, {}, rig=inaccurate(LOAD.rig, 1.5))
    assert outcome.tracked(BEGUN_S) > 0.95
    assert np.median(squared(outcome)) < chi2.isf(0.1, 3)
    assert outcome.log == []  # a rig that states nothing is not contradicted


def test_a_rig_without_errors_keeps_its_claims():
    outcome = fuse(LOAD, 2.5, {})
    sigmas = [
        np.sqrt(np.diag(p.covariance_matrix)[3:6].mean()) for p in outcome.poses if p.state == "tracked"
    ]
    assert np.median(sigmas) < 1.5e-3
    assert np.median(squared(outcome)) < chi2.isf(0.1, 3)


def test_claims_grow_at_once_and_fall_slowly():
    def verdict(scale: float, *cameras: int) -> Verdict:
        return Verdict(None, cameras, fitted(None, (), 2, 0.0), scale=scale)

    def of_rig(scale: float) -> Verdict:
        return Verdict(None, (), fitted(None, (), 2, 0.0, scale), scale=scale)

    assert next_scales(1.0, 1.0, verdict(16.0, 0, 1), True, 0.5) == (1.0, 16.0)  # undecided: only claims grow
    assert next_scales(1.0, 1.0, of_rig(16.0), False, 0.5) == (1.0, 16.0)
    assert next_scales(1.0, 1.0, of_rig(16.0), True, 0.5) == (16.0, 16.0)
    accepted, claimed = next_scales(16.0, 32.0, verdict(0.1), False, 0.9)
    assert 8.0 < accepted < 16.0 < claimed < 32.0
    # Cameras contradict each other still.
    assert next_scales(1.0, 16.0, verdict(0.1, 0, 1), True, 0.5) == (1.0, 16.0)
    assert next_scales(1.0, 1.0, verdict(0.1), False, 0.5) == (1.0, 1.0)  # never below what the rig states
