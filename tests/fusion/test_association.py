# SPDX-License-Identifier: BSD-3-Clause
"""Gates are as wide as the states' covariances make them."""

import numpy as np
import pytest

from fusion.association import _Expected
from fusion.sightings import Catalogue
from fusion.state import States, exp_so3
from tests.fusion.synthetic import WIDE


def place(states: States, marker: np.ndarray, tau: float) -> np.ndarray:
    """(N, 3) where a marker is `tau` after the instant: carried by velocity and turning rate."""
    arm = np.einsum("nij,j->ni", states.R, marker)
    return states.p + arm + tau * (states.v + np.cross(states.omega, arm))


@pytest.mark.parametrize("tau", [0.0, 0.02, -0.05])
def test_a_markers_covariance_is_that_of_displaced_states(tau: float):
    """Against J P J^T by central differences, of a body that does not turn: exact to their second order, 1e-8."""
    random = np.random.default_rng(5)
    root = 0.1 * random.normal(size=(1, 12, 12))
    R = exp_so3(np.array([[0.4, -0.8, 1.1]]))
    v, still = random.normal(size=(1, 3)), np.zeros((1, 3))
    states = States(R, random.normal(size=(1, 3)), still, v, root @ root.transpose(0, 2, 1))
    catalogue = Catalogue.of([WIDE])
    found = _Expected.of(states, catalogue, np.array([True])).covariance(np.array([tau]))
    steps = 1e-4 * np.eye(12)[:, None]
    for k, marker in enumerate(catalogue.marker.T):
        J = np.column_stack(
            [
                (place(states.moved(step), marker, tau) - place(states.moved(-step), marker, tau))[0] / 2e-4
                for step in steps
            ]
        )
        np.testing.assert_allclose(found[:, :, k], J @ states.P[0] @ J.T, atol=1e-7)
