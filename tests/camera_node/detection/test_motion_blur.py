# SPDX-License-Identifier: BSD-3-Clause
"""Roundels that move during the exposure: they are tracked and found, with a consistent covariance.

The images are means of many sharp ones (`rendering.render`), independent of the averaged model of the fit.
"""

import numpy as np
import pytest

from camera_node.detection.detector import Detector
from camera_node.simulation.sensor import CLEAN
from tests.benchmarks.detector.cameras import moving
from tests.benchmarks.detector.pictures import Card, missed, outline_of, render
from tests.camera_node.tracing import expose

SIZE = (72, 88)
DIAMETER = 32.0
START = (34.0, 38.0)
AT = (45.3, 34.8)  # in mid-exposure
PART = 1.0  # pixels of motion from one sharp image to the next


def exposed(length: float, turn: float, tilt: float, ground: float) -> np.ndarray:
    """Grey levels of a disc that moves by `length` pixels, in mid-exposure at AT."""
    n = int(np.ceil(length / PART))
    times = ((np.arange(n) + 0.5) / n - 0.5) * length
    places = [(AT[0] + t * np.cos(turn), AT[1] + t * np.sin(turn)) for t in times]
    discs = [Card(at, DIAMETER, tilt, turn=1.0) for at in places]
    return np.mean([render([disc], SIZE, ground=ground, blur=0.7) for disc in discs], axis=0)


@pytest.mark.ci
@pytest.mark.parametrize("length", [pytest.param(12.0, marks=pytest.mark.slow), 24.0])
def test_moving_roundels_are_tracked_with_a_consistent_covariance(length: float):
    """They are found in six directions; squared Mahalanobis errors have mean 2, and four sigmas of the mean are 0.82.

    A quarter more is allowed for the renderer: for its resolution of an eighth of a pixel, and for the view, which
    changes by 0.02 rad during the motion.
    """
    rng, squared = np.random.default_rng(11), []
    for k, turn in enumerate(np.pi * np.arange(6) / 6):
        tilt, ground = (0.0, 0.3, 0.6)[k % 3], (190.0, 90.0)[k % 2]
        sharp = render([Card(START, DIAMETER, tilt, turn=1.0)], SIZE, ground=ground)
        clean = exposed(length, turn, tilt, ground)
        centre = outline_of(Card(AT, DIAMETER, tilt, turn=1.0), SIZE)[0]
        for _ in range(16):
            detector = Detector()
            (before,) = detector.detect(expose(sharp, 3, rng))
            (found,) = detector.detect(expose(clean, 3, rng))
            assert found.track == before.track
            error = found.uv - centre
            squared.append(error @ np.linalg.solve(found.cov, error))
    assert 2 - 0.82 < np.mean(squared) < 2 + 0.82 + 0.25


@pytest.mark.parametrize("length", [pytest.param(12.0, marks=pytest.mark.slow), 24.0])
def test_moving_roundels_are_found_on_the_first_frame_with_a_consistent_covariance(length: float):
    """A new detector finds 95 % in twelve directions; the limits on squared errors are those of tracked roundels."""
    rng, squared, n_frames = np.random.default_rng(12), [], 0
    for k, turn in enumerate(np.pi * np.arange(12) / 12):
        tilt, ground = (0.0, 0.3, 0.6)[k % 3], (190.0, 90.0)[k % 2]
        clean = exposed(length, turn, tilt, ground)
        centre = outline_of(Card(AT, DIAMETER, tilt, turn=1.0), SIZE)[0]
        for _ in range(8):
            n_frames += 1
            for found in Detector().detect(expose(clean, 3, rng)):
                error = found.uv - centre
                squared.append(error @ np.linalg.solve(found.cov, error))
    assert len(squared) >= 0.95 * n_frames
    assert 2 - 0.82 < np.mean(squared) < 2 + 0.82 + 0.25


def test_a_new_moving_roundel_is_found_in_both_diagonal_directions():
    """In the first frame; with a search share of a half, within two frames."""
    rng, plain = np.random.default_rng(6), np.full(SIZE, 190.0)
    for share in (1.0, 0.5):
        for turn in (np.pi / 4, 3 * np.pi / 4):
            detector, clean = Detector(search_share=share), exposed(24.0, turn, 0.0, 190.0)
            detector.detect(expose(plain, 3, rng))
            assert any(len(detector.detect(expose(clean, 3, rng))) for _ in range(round(1 / share)))


def test_short_motions_are_found_on_clutter_on_the_first_frame():
    """Nine of ten of 24 to 40 px that move by 10 px: their holes are not closed, and their bars are short."""
    there = lost = 0
    for seed in range(3):
        light, shown = moving(np.random.default_rng(seed))
        found = Detector().detect(CLEAN.expose(light, np.random.default_rng(seed)))
        lost += missed(shown, found.uv)
        there += len(shown)
        assert len(found) <= len(shown)
    assert lost <= 0.1 * there


def test_size_and_contrast_are_those_of_a_sharp_image():
    """Axes within 1 %, contrast within 3 %, although a motion of 20 px spreads a ring of 6 px over thrice its area."""
    detector, rng = Detector(), np.random.default_rng(4)
    detector.detect(expose(render([Card(START, DIAMETER, 0.4, turn=1.0)], SIZE), 2, rng))
    (found,) = detector.detect(expose(exposed(20.0, 0.7, 0.4, 90.0), 2, rng))
    assert found.axes_px == pytest.approx(outline_of(Card(AT, DIAMETER, 0.4, turn=1.0), SIZE)[1], rel=0.01)
    assert found.contrast == pytest.approx(150, rel=0.03)


@pytest.mark.parametrize("ground", [60.0, 190.0])
def test_a_roundel_that_disappears_is_not_found_in_noise(ground: float):
    detector, rng = Detector(), np.random.default_rng(5)
    assert len(detector.detect(expose(render([Card(START, DIAMETER)], SIZE, ground=ground), 3, rng))) == 1
    assert len(detector.detect(expose(np.full(SIZE, ground), 3, rng))) == 0
