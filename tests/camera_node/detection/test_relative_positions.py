# SPDX-License-Identifier: BSD-3-Clause
"""Positions relative to one camera: their covariance and the probabilities of the normals agree with the errors."""

from collections.abc import Iterator

import numpy as np
import pytest

from camera_node.detection.detector import Detector
from camera_node.detection.relative_positions import MAX_LOCATED, DiscLocalizer
from camera_node.detection.roundels import DetectedRoundels, LocatedRoundels
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.lens import Lens
from tests.camera_node.tracing import Sight, expose, pixels_across, trace

DIAMETER_M = 0.1
LENS = Lens(width=60, height=60, fx=600, fy=600, cx=150, cy=-60)


def located(
    px: float, tilts: tuple[float, float], n: int, seed: int
) -> Iterator[tuple[Sight, LocatedRoundels]]:
    """`n` ray-traced pictures of a roundel of `px` pixels, slanted by `tilts` from the line of sight (radians)."""
    rng = np.random.default_rng(seed)
    for _ in range(n // 10):
        uv = (29.5 + rng.uniform(-0.5, 0.5), 29.5 + rng.uniform(-0.5, 0.5))
        distance = pixels_across(LENS, DIAMETER_M, px)
        tilt, turn = rng.uniform(*tilts), rng.uniform(0, 2 * np.pi)
        sight = Sight(LENS, uv, distance, DIAMETER_M, tilt=tilt, turn=turn)
        clean = trace(sight, 4)
        for _ in range(10):
            found = DiscLocalizer(LENS, DIAMETER_M).locate(Detector().detect(expose(clean, 2.5, rng)))
            assert len(found) == 1
            yield sight, found


@pytest.mark.parametrize(("px", "tilts"), [(14, (0.0, 0.3)), (20, (0.1, 1.0)), (40, (0.0, 1.0))])
def test_the_claimed_errors_are_honest(px: float, tilts: tuple[float, float]):
    """Squared Mahalanobis distances have the mean 3 and the variance 6: five sigmas of the mean of 150 are 1.0.

    Errors of pictures with one pose share its sub-pixel errors, so that the spread is larger than that of independent
    ones; frontal discs and both normals are included.
    """
    squares, normals = [], []
    for sight, found in located(px, tilts, 150, seed=int(px)):
        e = found.position[0] - sight.position
        squares.append(e @ np.linalg.solve(found.cov[0], e))
        k = int(np.argmax(found.normals[0] @ sight.normal))
        error = np.arccos(np.clip(found.normals[0, k] @ sight.normal, -1, 1))
        normals.append((error / found.normal_sigma[0, k]) ** 2)
    assert np.mean(squares) == pytest.approx(3, abs=1.0)
    if tilts[0] > 0:  # a frontal disc has two minima, around the true normal
        assert 1 < np.mean(normals) < 3, (
            "two directions of a variance of at most 1 each, and a margin of 50 %"
        )


@pytest.mark.ci
def test_the_probabilities_of_the_normals_are_calibrated():
    """At 14 px and up to 17 degrees the normal is uncertain: the mean probability of the likelier one is 85 %.

    It is the true one as often, within three sigmas of 300 draws. Pairs that coincide say nothing and are left out.
    """
    claimed, right = [], []
    for sight, found in located(14, (0.02, 0.3), 300, seed=3):
        first, second = found.normals[0]
        if first @ second < np.cos(np.radians(1)):
            claimed.append(found.probability[0, 0])
            right.append(first @ sight.normal > second @ sight.normal)
    assert len(claimed) > 200
    assert 0.6 < np.mean(claimed) < 0.97, "no case is uncertain"
    sigma = np.sqrt(np.mean(claimed) * (1 - np.mean(claimed)) / len(claimed))
    assert np.mean(right) == pytest.approx(np.mean(claimed), abs=3 * sigma)


def test_the_distance_by_the_principal_axis_agrees_with_the_full_fit():
    """Within 0.2 % of the distance, both from one ellipse."""
    for _, found in located(40, (0.2, 1.0), 20, seed=5):
        assert found.axis_distance[0] == pytest.approx(np.linalg.norm(found.position[0]), rel=2e-3)


def test_the_number_of_located_roundels_is_bounded():
    """The largest ones remain."""
    (_, found), *_ = located(20, (0.2, 0.3), 10, seed=6)
    assert len(found) == 1
    image = expose(
        trace(Sight(LENS, (29.0, 30.0), pixels_across(LENS, DIAMETER_M, 20))), 1, np.random.default_rng(1)
    )
    one = Detector().detect(image)
    many = one.select(np.zeros(3 * MAX_LOCATED, int))
    sizes = np.linspace(1, 2, len(many))[:, None]
    grown = DetectedRoundels(
        **{
            name: getattr(many, name)
            for name in ("uv", "cov", "angle_rad", "ratio", "contrast", "id", "track")
        },
        axes_px=many.axes_px * sizes,
        offset_px=many.offset_px,
        pose_cov=many.pose_cov,
    )
    nearest = DiscLocalizer(LENS, DIAMETER_M).locate(grown)
    assert len(nearest) == MAX_LOCATED
    everything = one.axes_px[0, 0] * sizes
    assert np.linalg.norm(nearest.position, axis=1).max() < 600 * DIAMETER_M / np.median(everything) * 1.1


def test_intrinsics_of_another_image_size_are_refused():
    localizer = DiscLocalizer(LENS, DIAMETER_M)
    localizer.check_size(60, 60)
    with pytest.raises(ConfigError, match="640 x 480 px, but its intrinsics are for 60 x 60"):
        localizer.check_size(640, 480)
    with pytest.raises(ConfigError, match="diameter"):
        DiscLocalizer(LENS, 0.0)


def test_a_frame_without_roundels_has_no_positions():
    nothing = Detector().detect(np.full((60, 60), 128, np.uint8))
    assert len(DiscLocalizer(LENS, DIAMETER_M).locate(nothing)) == 0
