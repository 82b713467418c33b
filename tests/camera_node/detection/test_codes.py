# SPDX-License-Identifier: BSD-3-Clause
"""Names and headings of coded roundels in rendered pictures: right, or unknown."""

from dataclasses import replace

import numpy as np
import pytest

from camera_node.detection.detector import Detector
from camera_node.detection.roundels import DetectedRoundels
from camera_node.foundation.arrays import Grey, Index
from camera_node.geometry import codes
from camera_node.simulation.sensor import Sensor
from tests.benchmarks.codes import pictures
from tests.benchmarks.detector.pictures import Card, dead_leaves, expose, flat, grid, paste, rotation_of
from tests.benchmarks.detector.recall import occlude

SIZE = (300, 400)


def cards(count: int, diameter: float, tilt: float, seed: int) -> list[Card]:
    """Cards with different codes, turned and tilted in random directions."""
    rng = np.random.default_rng(seed)
    numbers = rng.permutation(len(codes.words()))[:count] + 1
    return [
        Card(
            uv, diameter, tilt, *rng.uniform(0, 2 * np.pi, 1), card=codes.CARD, code=int(n), spin=float(spin)
        )
        for uv, n, spin in zip(grid(count, SIZE, rng), numbers, rng.uniform(0, 2 * np.pi, count), strict=True)
    ]


def picture(shown: list[Card], seed: int, clutter: bool = True) -> Grey:
    rng = np.random.default_rng(seed)
    return expose(paste(dead_leaves(SIZE, rng) if clutter else flat(SIZE, 90.0), shown), 3.0, rng)


def rows_of(found: DetectedRoundels, shown: list[Card]) -> Index:
    """The detection of each card."""
    apart = np.linalg.norm(found.uv[None] - np.array([card.uv for card in shown])[:, None], axis=2)
    assert (apart.min(1) < 3).all()
    return apart.argmin(1)


@pytest.mark.parametrize(("diameter", "tilt"), [(12.0, 0.0), (16.0, 0.8), (30.0, 1.05)])
def test_one_frame_names_and_turns_cards(diameter: float, tilt: float):
    """All names are right. Squared errors of the headings over their variances have the mean 1, that of a median-like
    estimate of the noise from six edges or more at most 3; nothing is off by a sector."""
    shown = cards(30, diameter, tilt, 1)
    found = Detector().detect(picture(shown, 2))
    rows = rows_of(found, shown)
    assert found.id[rows].tolist() == [card.code for card in shown]
    assert (found.id_probability[rows] > 1 - 2e-6).all()
    error = found.rotation_rad[rows] - [rotation_of(card, SIZE) for card in shown]
    error = (error + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(error).max() < codes.STEP / 4
    assert np.mean((error / found.rotation_sigma[rows]) ** 2) < 3


def test_a_tone_curve_that_one_picture_shows_hides_no_name():
    """Covered roundels are decided in the linearized picture, after the fits of the others: these have other levels."""
    rng = np.random.default_rng(9)
    places = grid(30, SIZE, rng)
    shown = [replace(card, uv=uv) for card, uv in zip(cards(20, 20.0, 0.3, 9), places[:20], strict=True)]
    plain = [Card(uv, 24.0) for uv in places[20:]]
    light = paste(flat(SIZE, 90.0), [*shown, *plain])
    for card in plain:
        occlude(light, card, 0.2, 0.5, rng)
    found = Detector().detect(Sensor(noise=0.5, tone="gamma").expose(light, rng))
    assert found.id[rows_of(found, shown)].tolist() == [card.code for card in shown]


def test_mirrored_codes_have_no_name():
    shown = cards(30, 24.0, 0.5, 3)
    image = picture(shown, 4)
    assert (Detector().detect(image).id > 0).sum() == 30
    detector = Detector()
    for _ in range(3):
        found = detector.detect(np.ascontiguousarray(image[:, ::-1]))
        assert len(found) >= 30
        assert (found.id == -1).all()
        assert np.isnan([found.id_probability, found.rotation_rad, found.rotation_sigma]).all()


@pytest.mark.parametrize("clutter", [False, True])
def test_plain_roundels_have_no_name(clutter: bool):
    shown = [replace(card, code=0, card=9 / 7) for card in cards(30, 20.0, 0.4, 5)]
    detector = Detector()
    for seed in range(4):
        found = detector.detect(picture(shown, seed, clutter))
        assert len(found) >= 30
        assert (found.id == -1).all()


def test_frames_of_a_track_add_up():
    """Faint codes whose single frames are uncertain get their names from several, and none a wrong one."""
    shown = cards(20, 14.0, 1.1, 6)
    detector, named = Detector(), []
    for seed in range(8):
        rng = np.random.default_rng((7, seed))
        found = detector.detect(expose(paste(flat(SIZE, 90.0), shown, dark=70.0, bright=130.0), 5.0, rng))
        apart = np.linalg.norm(found.uv[:, None] - np.array([card.uv for card in shown])[None], axis=2)
        due = np.array([card.code for card in shown])[apart.argmin(1)]
        assert (found.id[found.id > 0] == due[found.id > 0]).all()
        named.append(int((found.id > 0).sum()))
    assert named[0] < 0.9 * named[-1]


def test_a_track_that_becomes_another_card_changes_its_name_or_has_none():
    shown = cards(12, 24.0, 0.3, 8)
    detector = Detector()
    for seed in range(6):
        detector.detect(picture(shown, seed))
    other = [replace(card, code=card.code % len(codes.words()) + 1) for card in shown]
    ids = np.empty(0)
    for seed in range(6, 9):
        found = detector.detect(picture(other, seed))
        ids = found.id[rows_of(found, other)]
        assert all(name in (-1, card.code) for name, card in zip(ids.tolist(), other, strict=True))
    assert ids.tolist() == [card.code for card in other]


@pytest.mark.parametrize(("diameter", "tilt"), [(16.0, 60.0), (12.0, 45.0)])
def test_a_second_frame_shows_thin_rings_behind_a_tone_curve(diameter: float, tilt: float):
    """The second search has a threshold half way in light: 98.5 % are found; 94 is four deviations less."""
    first, last = pictures.measure(
        pictures.SCENES["first, mild"], (diameter, diameter), (tilt, tilt), True, 144, 2
    )
    assert last.wrong == 0
    assert last.found > first.found
    assert last.found >= 0.94 * last.shown
