# SPDX-License-Identifier: BSD-3-Clause
"""Refused rings: each is listed with the test that it fails, and roundels are not among them."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from camera_node.commands.detect import Detect
from camera_node.detection.detector import Detector
from camera_node.detection.refusals import Reason, RefusedRing, explain
from camera_node.foundation.errors import CameraError, ConfigError
from camera_node.simulation.sensor import MILD
from tests.benchmarks.detector.pictures import Card, expose, flat, grid, paste

SIZE, MIDDLE = (120, 160), (80.3, 60.2)
THIN_SIZE = (200, 260)


def picture(*cards: Card, floor: float = 90.0, **levels: float) -> np.ndarray:
    return paste(flat(SIZE, floor), list(cards), **levels)


def refused(light: np.ndarray, **settings: Any) -> list[RefusedRing]:
    image = expose(light, 2.0, np.random.default_rng(1))
    detector = Detector(**settings)
    return explain(detector, image, detector.detect(image))


def bullseye() -> np.ndarray:
    light = flat(SIZE, 90.0)
    for radius, level in ((50, 190), (42, 40), (35, 190), (28, 40), (21, 190), (14, 40), (8, 190)):
        cv2.circle(light, (80, 60), radius, float(level), -1, cv2.LINE_AA)
    return np.asarray(cv2.GaussianBlur(light, (0, 0), 0.7), float)


@pytest.mark.parametrize(
    ("light", "settings", "reason"),
    [
        (picture(Card(MIDDLE, 44, ratio=0.85)), {}, Reason.RATIO),
        (picture(Card(MIDDLE, 44)), {"inner_ratios": (0.41,)}, Reason.RATIO),
        (picture(Card(MIDDLE, 44), dark=70.0, bright=90.0), {}, Reason.CONTRAST),
        (picture(Card(MIDDLE, 20)), {"min_diameter_px": 30.0}, Reason.SIZE),
        (picture(Card(MIDDLE, 44)), {"max_diameter_px": 40.0}, Reason.SIZE),
        (picture(Card(MIDDLE, 14), floor=190.0, dark=140.0), {}, Reason.PALE_INK),
        (bullseye(), {}, Reason.BULLSEYE),
    ],
    ids=["thin ring", "other print", "faint", "small", "large", "thin and pale", "bullseye"],
)
def test_a_refused_ring_is_listed_with_the_test_that_it_fails(light, settings: dict, reason: Reason):
    """The centre is within a pixel of the ring's; the text says what was measured."""
    near = [ring for ring in refused(light, **settings) if np.linalg.norm(ring.uv - MIDDLE) < 1]
    assert reason in [ring.reason for ring in near]
    assert all(ring.text for ring in near)


def test_a_roundel_that_is_found_is_not_listed():
    assert refused(picture(Card(MIDDLE, 30), Card((30, 30), 20, 0.6))) == []


def test_thin_rings_are_no_roundels_with_pale_ink():
    """Blur makes rings of 0.8 to 0.9 and 12 to 20 px look like rings of a print with a sixth of the contrast."""
    rng = np.random.default_rng(1)
    cards = [
        Card(uv, float(rng.uniform(12, 20)), ratio=float(rng.uniform(0.8, 0.92)))
        for uv in grid(30, THIN_SIZE, rng)
    ]
    light = paste(flat(THIN_SIZE, 190.0), cards, blur=1.2)
    assert len(Detector(inner_ratios=(0.6, 0.41)).detect(MILD.expose(light, rng))) == 0


def test_thin_rings_that_are_refused_are_those_of_pale_ink():
    """Roundels of the same sizes are found at a contrast of 50 on paper of 120, as in poor light."""
    rng = np.random.default_rng(2)
    cards = [Card(uv, float(rng.uniform(12, 20))) for uv in grid(30, THIN_SIZE, rng)]
    light = paste(flat(THIN_SIZE, 120.0), cards, dark=70.0, bright=120.0)
    assert len(Detector().detect(expose(light, 2.0, rng))) == len(cards)


def test_flat_noise_has_no_rings():
    assert refused(flat(SIZE, 120.0)) == []


def test_explaining_changes_nothing():
    """The detector finds the same afterwards, with the same tracks."""
    image = expose(picture(Card(MIDDLE, 30), Card((30, 30), 20, ratio=0.85)), 2.0, np.random.default_rng(1))
    asked, other = Detector(), Detector()
    first = asked.detect(image)
    other.detect(image)
    explain(asked, image, first)
    one, two = asked.detect(image), other.detect(image)
    assert np.array_equal(one.uv, two.uv)
    assert np.array_equal(one.track, two.track)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, card in (("found", Card(MIDDLE, 40)), ("thin", Card(MIDDLE, 44, ratio=0.85))):
        cv2.imwrite(str(tmp_path / f"{name}.png"), expose(picture(card), 2.0, np.random.default_rng(1)))
    return tmp_path


def test_the_command_explains_all_pictures_of_a_folder(folder: Path, capsys: pytest.CaptureFixture[str]):
    drawn = folder / "drawn"
    assert Detect(images=(folder,), json=True, why=True, draw=drawn).run() == 0
    found, thin = (json.loads(line) for line in capsys.readouterr().out.splitlines())
    assert (len(found["roundels"]), len(thin["roundels"])) == (1, 0)
    assert "ratio" in [ring["reason"] for ring in thin["refused"]]
    assert len(list(drawn.iterdir())) == 2


def test_the_command_says_why_in_words(folder: Path, capsys: pytest.CaptureFixture[str]):
    Detect(images=(folder / "thin.png",), why=True).run()
    assert "ratio 0.85" in capsys.readouterr().out


def test_the_command_takes_the_settings_of_the_detector(folder: Path, capsys: pytest.CaptureFixture[str]):
    Detect(images=(folder / "found.png",), json=True, why=True, min_contrast=200.0).run()
    line = json.loads(capsys.readouterr().out)
    assert line["roundels"] == []
    assert "contrast" in [ring["reason"] for ring in line["refused"]]
    with pytest.raises(ConfigError, match="min_contrast"):
        Detect(images=(folder / "found.png",), min_contrast=1.0).run()


def test_a_folder_without_pictures_is_refused(tmp_path: Path):
    with pytest.raises(CameraError, match="no picture"):
        Detect(images=(tmp_path,)).run()
