# SPDX-License-Identifier: BSD-3-Clause
"""Covariances in messages."""

import numpy as np
import pytest

from fusion.protocol.pose_messages import ROUNDED, covariance_bytes


@pytest.mark.parametrize("seed", range(20))
def test_covariances_are_positive_definite_after_rounding(seed: int):
    """Also of errors of a metre in one direction and of 0.01 mm across it, which <f4 cannot tell apart."""
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(12, 12)))[0]
    P = axes * np.geomspace(1.0, 1e-10, 12) @ axes.T
    sent = np.frombuffer(covariance_bytes(P[None]), "<f4").reshape(12, 12).astype(float)
    assert np.linalg.eigvalsh(sent).min() > 0
    np.testing.assert_allclose(sent, P, rtol=3 * ROUNDED, atol=0)
