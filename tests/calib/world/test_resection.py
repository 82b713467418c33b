# SPDX-License-Identifier: BSD-3-Clause
"""One camera is placed by roundels at known points, with a covariance that is true; what leaves its pose open is
refused."""

import numpy as np
import pytest

from calib.errors import CalibrationError
from calib.rig.camera import Camera
from calib.world.resection import SIGMA_PX, place_by_points
from calib.world.still_roundels import StillRoundel, find_still_roundels
from camera_node.geometry.pose import invert, vector_from_rotation
from tests.calib.synthetic import ring
from tests.calib.world.landmarks import detect_landmarks

FLOOR = {
    "0": [0.0, 0.0, 0.0],
    "1": [0.9, 0.1, 0.0],
    "2": [-0.2, 0.7, 0.0],
    "3": [-0.7, -0.5, 0.0],
    "4": [0.5, -0.8, 0.0],
}
POINTS = {name: np.array(at) for name, at in FLOOR.items()}
SIGMA_M = 0.002
UNKNOWN_SHAPE = np.full((2, 2), np.nan)


def camera() -> Camera:
    return ring(4).truth.cameras["cam1"]


def see(points: dict[str, np.ndarray], number: bool = True, noise_px: np.ndarray | float = 0.0):
    """The roundels at the points in the camera."""
    uv = camera().project_world(np.array(list(points.values()))) + noise_px
    return [
        StillRoundel("cam1", at, name if number else "", UNKNOWN_SHAPE)
        for name, at in zip(points, uv, strict=True)
    ]


def pose_error(found: Camera) -> np.ndarray:
    """(6,) rotation and translation in the camera's own frame."""
    off = invert(found.matrix()) @ camera().matrix()
    return np.append(vector_from_rotation(off[:3, :3]), off[:3, 3])


def test_the_covariance_of_the_pose_is_true():
    """Squared Mahalanobis errors have the mean 6 and the variance 12; the covariance of points that happen to fit badly
    is larger by their chi-square over 4 degrees, on average by a quarter."""
    rng, squared, draws = np.random.default_rng(3), [], 60
    for _ in range(draws):
        given = {name: at + SIGMA_M * rng.standard_normal(3) for name, at in POINTS.items()}
        roundels = see(POINTS, noise_px=SIGMA_PX * rng.standard_normal((len(POINTS), 2)))
        found = place_by_points("cam1", camera(), roundels, given, SIGMA_M).camera
        error = pose_error(found)
        squared.append(error @ np.linalg.solve(np.array(found.covariance), error))
    slack = 4 * np.sqrt(12 / draws)
    assert 6 / 1.25 - slack < np.mean(squared) < 6 + slack


@pytest.mark.parametrize("numbered", [False, True])
def test_roundels_need_no_numbers(numbered: bool):
    """Means of ten views to 0.05 px with a false roundel: below 2 mm at 3.5 m, as SIGMA_PX / f would give 1.3 mm."""
    messages = detect_landmarks(ring(4), FLOOR, numbered, clutter=1)
    roundels = [r for r in find_still_roundels(messages) if r.camera == "cam1"]
    found = place_by_points("cam1", camera(), roundels, POINTS, SIGMA_M)
    assert set(found.misses_m) == set(FLOOR)
    assert max(found.misses_m.values()) < 1e-3
    assert np.linalg.norm(pose_error(found.camera)[3:]) < 2e-3


SQUARE = {
    str(k): np.array([x, y, 0.0])
    for k, (x, y) in enumerate([(0.5, 0.5), (-0.5, 0.5), (-0.5, -0.5), (0.5, -0.5)])
}
LINE = {str(k): np.array([0.3 * k - 0.6, 0.0, 0.0]) for k in range(5)}


@pytest.mark.parametrize(
    ("seen", "points", "numbered", "reason"),
    [
        ({name: POINTS[name] for name in "012"}, POINTS, True, "sees 3 of the points; its pose needs 4"),
        (LINE, LINE, True, "not on a line"),
        (SQUARE, SQUARE, False, "in two ways"),
        (POINTS, SQUARE, False, "no 4 are where the points are"),
        (
            {"0": POINTS["1"], "1": POINTS["0"], "2": POINTS["3"], "3": POINTS["2"], "4": POINTS["4"]},
            POINTS,
            True,
            "check their names",
        ),
    ],
)
def test_what_leaves_a_pose_open_is_refused(seen, points, numbered: bool, reason: str):
    with pytest.raises(CalibrationError, match=reason):
        place_by_points("cam1", camera(), see(seen, numbered), points, SIGMA_M)


def test_distant_points_in_a_plane_with_two_poses_are_refused():
    """Points of 4 cm, three metres away: their perspective is below the noise, so the plane may be tilted both ways."""
    small = {name: 0.04 * at for name, at in POINTS.items()}
    with pytest.raises(CalibrationError, match="two poses fit the points"):
        place_by_points("cam1", camera(), see(small), small, 1e-4)
