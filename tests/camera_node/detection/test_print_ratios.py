# SPDX-License-Identifier: BSD-3-Clause
"""Prints of unknown ratio: found, and distinguished from the effect of a tone curve."""

from functools import cache

import numpy as np
import pytest

from camera_node.detection.detector import Detector
from camera_node.foundation.arrays import Array, Grey
from camera_node.simulation.sensor import CLEAN, MILD, Sensor
from tests.benchmarks.detector.cameras import share_of_print
from tests.benchmarks.detector.models import SHARPENED
from tests.benchmarks.detector.pictures import Card, flat, paste
from tests.benchmarks.detector.table import Run

SIZE = (180, 260)
SIZES = (20, 24, 28, 34, 40, 44)  # pixels


def frame(ratio: float, sensor: Sensor, seed: int = 1, sizes: tuple[float, ...] = SIZES) -> Grey:
    """Six roundels of a print, each on its card, at random positions on a grid."""
    return sensor.expose(light(ratio, seed, sizes), np.random.default_rng(seed))


@cache
def light(ratio: float, seed: int, sizes: tuple[float, ...]) -> Array:
    rng = np.random.default_rng(seed)
    places = [(50 + 80 * (k % 3), 50 + 80 * (k // 3)) for k in range(len(sizes))]
    cards = [
        Card((u + rng.uniform(), v + rng.uniform()), d, float(rng.uniform(0, 0.6)), ratio=ratio)
        for (u, v), d in zip(places, sizes, strict=True)
    ]
    return paste(flat(SIZE, 90.0), cards)


@pytest.mark.parametrize("sensor", [CLEAN, MILD], ids=["clean", "mild"])
@pytest.mark.parametrize("ratio", [0.3, 0.5, 0.7])
def test_any_print_is_found(ratio: float, sensor: Sensor):
    """Its ratio is known within 0.03: a tone curve displaces it by up to 0.05 at these sizes."""
    detector = Detector()
    counts = [len(detector.detect(frame(ratio, sensor, seed))) for seed in range(4)]
    assert counts[1:] == [len(SIZES)] * 3
    assert detector.found_ratios == pytest.approx([ratio], abs=0.03)


def test_thin_rings_of_an_unknown_print_are_found_behind_a_filmic_curve():
    """It makes 0.75 to 0.81 of a ratio of 0.7; a limit of 0.75 for all sizes left a quarter of them."""
    assert share_of_print(Run("chords", Detector, False), SHARPENED["filmic and sharpened"], 0.7, 1) > 0.8


def test_a_single_roundel_of_an_unknown_print_is_found():
    detector = Detector()
    counts = [len(detector.detect(frame(0.5, CLEAN, seed, (30.0,)))) for seed in range(3)]
    assert counts == [1, 1, 1]
    assert detector.found_ratios == ()


def test_a_lone_print_of_another_ratio_is_found_beside_one_that_recurs():
    """What a fresh detector finds, one that knows a print finds in the same frame; given ratios exclude it."""
    other = frame(0.7, CLEAN, 5, (30.0, 34.0))
    assert len(Detector().detect(other)) == 2
    detector = Detector()
    for seed in range(3):
        detector.detect(frame(0.5, CLEAN, seed))
    assert len(detector.detect(np.full(SIZE, 190, np.uint8))) == 0
    assert len(detector.detect(other)) == 2
    assert len(detector.adjusted(inner_ratios=(0.5,)).detect(other)) == 0


def test_the_usual_prints_are_found_beside_a_new_one():
    detector = Detector()
    for seed in range(3):
        detector.detect(frame(0.7, CLEAN, seed))
    assert len(detector.detect(frame(0.41, CLEAN, 9, (30.0,)))) == 1


def test_each_camera_has_its_own_print():
    """Two detectors in turn, as in a process with two cameras."""
    detectors = {0.3: Detector(), 0.7: Detector()}
    counts = [
        [len(detector.detect(frame(ratio, CLEAN, seed))) for ratio, detector in detectors.items()]
        for seed in range(3)
    ]
    assert counts[-1] == [len(SIZES)] * 2
    for ratio, detector in detectors.items():
        assert detector.found_ratios == pytest.approx([ratio], abs=0.01)


def test_a_print_that_replaces_another_one_is_found_and_learned_at_once():
    detector = Detector()
    for seed in range(3):
        detector.detect(frame(0.5, CLEAN, seed))
    assert len(detector.detect(frame(0.3, CLEAN, 4))) == len(SIZES)
    assert sorted(detector.found_ratios) == pytest.approx([0.3, 0.5], abs=0.01)


def test_beside_rings_that_recur_the_usual_prints_are_found_and_given_ratios_exclude_the_rings():
    """A carpet with rings of 0.3 and one roundel of 0.6: no picture tells which of both somebody printed."""
    carpet, own = light(0.3, 1, SIZES), light(0.6, 7, (30.0,))
    scene = np.hstack([carpet, own[:, :110]])
    detector, given = Detector(), Detector(inner_ratios=(0.6,))
    counts = []
    for seed in range(4):
        image = CLEAN.expose(scene, np.random.default_rng(seed))
        found, strict = detector.detect(image), given.detect(image)
        counts.append(len(found))
        assert np.sum(np.abs(found.ratio - 0.6) < 0.02) == 1
        assert len(strict) == 1
        assert strict.ratio[0] == pytest.approx(0.6, abs=0.02)
    assert counts[-1] == 1 + len(SIZES)
    assert detector.found_ratios == pytest.approx([0.3], abs=0.01)


def test_given_ratios_are_the_only_ones():
    detector = Detector(inner_ratios=(0.6,))
    assert sum(len(detector.detect(frame(0.41, CLEAN, seed))) for seed in range(3)) == 0
    assert detector.found_ratios == ()


def test_one_size_of_an_unknown_print_leaves_the_tone_curve_undetermined():
    """Its ratio and the tone curve have the same effect there; a known print separates them."""
    sizes = (24.0,) * 6
    unknown, known = Detector(), Detector(inner_ratios=(0.5,))
    for seed in range(4):
        image = frame(0.5, MILD, seed, sizes)
        unknown.detect(image)
        known.detect(image)
    assert unknown.tone_exponent is None
    assert known.tone_exponent == pytest.approx(2.2, rel=0.15)


@pytest.mark.parametrize(("tone", "exponent"), [("linear", 1.0), ("gamma", 2.2)])
def test_several_sizes_of_an_unknown_print_determine_the_tone_curve(tone, exponent):
    """Roundels that approach and recede: the ratio follows from the regression on 1 / size.

    Its standard deviation of about 0.003 is one of 7 % of the exponent at 28 px; three are allowed.
    """
    detector, sizes = Detector(), (20.0, 24.0, 28.0, 48.0, 52.0, 56.0)
    for seed in range(6):
        turned = sizes[seed:] + sizes[:seed]
        detector.detect(frame(0.5, Sensor(noise=2.0, tone=tone), seed, turned))
    assert detector.tone_exponent == pytest.approx(exponent, rel=0.2)
