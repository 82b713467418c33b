# SPDX-License-Identifier: BSD-3-Clause
"""Zones of a hall with cameras along its length: own, used and adopted cameras, and the expected variances."""

import msgspec
import numpy as np
import pytest

from camera_node.geometry.pose import Pose, look_at
from fusion.server.zones.zone_cameras import ZoneCameras
from tests.fusion.synthetic import TRIANGLE
from tests.fusion.zone_hall import hall, pairs

ZONES = {"west": pairs(0, 1), "middle": pairs(2, 3), "east": pairs(4, 5)}
CAMERAS = ZoneCameras(hall(6), ZONES, TRIANGLE.diameter_m)


def test_a_zone_uses_its_neighbours_cameras_at_the_border_only():
    own = CAMERAS.own(ZONES)
    assert {zone: set(names) for zone, names in ZONES.items()} == own
    assert CAMERAS.used(own["west"]) == set(pairs(0, 1, 2))
    assert CAMERAS.used(own["middle"]) == set(pairs(1, 2, 3, 4))


@pytest.mark.parametrize("seed", range(5))
def test_the_used_cameras_see_what_own_cameras_see(seed: int):
    """No other camera sees a place that the zone's own cameras see; random places above the floor."""
    points = np.random.default_rng(seed).uniform([-2, -2, 0], [15, 2, 1.5], (2000, 3))
    used = CAMERAS.used(ZONES["middle"])
    seen = points[CAMERAS.look_at(points).by(ZONES["middle"])]
    others = set(hall(6)) - used
    assert len(seen) > 100
    assert not CAMERAS.look_at(seen).by(others).any()


def test_neighbours_adopt_the_cameras_of_a_dead_zone():
    """Each those that overlap with its own; one that no zone lists belongs to the zone beside it."""
    assert CAMERAS.own({"west", "east"}) == {"west": set(pairs(0, 1, 2)), "east": set(pairs(3, 4, 5))}
    assert CAMERAS.own({"east"}) == {"east": set(hall(6))}
    unlisted = ZoneCameras(hall(6), {"west": pairs(0, 1), "east": pairs(4, 5)}, TRIANGLE.diameter_m)
    assert unlisted.own({"west", "east"}) == CAMERAS.own({"west", "east"})


def test_cameras_without_any_overlap_belong_to_the_first_living_zone():
    away = Pose.from_matrix(look_at([90, 0, 3], [90, 1, 0]))
    far = msgspec.structs.replace(hall(1)["n0"], T_world_cam=away)
    cameras = ZoneCameras({**hall(4), "far": far}, {"west": pairs(0, 1), "east": pairs(2, 3)}, 0.1)
    assert "far" in cameras.own({"west", "east"})["west"]
    assert cameras.own({"east"}) == {"east": {*hall(4), "far"}}
    assert cameras.own(()) == {}


def test_expected_variances_are_those_of_simulated_views():
    """Of many noisy views of a point by least squares, the mean squared error is the expected variance."""
    rng, point, own = np.random.default_rng(1), np.array([3.0, 0.2, 0.3]), pairs(0, 1)
    rig, diameter, sigma_px = hall(6), TRIANGLE.diameter_m, 0.1

    def measure(p: np.ndarray) -> np.ndarray:
        """Centres and sizes in the images of the own cameras that see the point."""
        out = []
        for name in own:
            if CAMERAS.look_at(p[None]).by({name})[0]:
                z = (np.linalg.inv(rig[name].matrix()) @ [*p, 1.0])[2]
                out += [*rig[name].project_world(p[None])[0], 650.5 * diameter / z]
        return np.array(out)

    step = 1e-5
    J = np.column_stack([(measure(point + d) - measure(point - d)) / (2 * step) for d in step * np.eye(3)])
    errors = np.linalg.pinv(J) @ rng.normal(0, sigma_px, (len(J), 4000))
    measured = (errors**2).sum(axis=0).mean() / sigma_px**2
    expected = CAMERAS.look_at(point[None]).variances(own)[0]
    assert measured == pytest.approx(expected, rel=0.1)  # 4000 samples of three squares: 4 standard errors
    assert CAMERAS.look_at(np.array([[16.0, 0, 0.2]])).variances(own)[0] == np.inf
