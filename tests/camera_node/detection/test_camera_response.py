# SPDX-License-Identifier: BSD-3-Clause
"""The detector behind a camera's processing: tone curves, light that falls off, compression, clipped paper."""

from dataclasses import replace
from functools import cache, partial

import msgspec
import numpy as np
import pytest

from camera_node.detection.detector import Detector
from camera_node.foundation.arrays import Array, Grey
from camera_node.simulation.sensor import HARSH, MILD, Sensor
from tests.benchmarks.codes import pictures
from tests.benchmarks.detector.cameras import (
    Camera,
    Errors,
    acquainted,
    cards,
    covered,
    errors,
    over_exposed,
    share_found,
    uncovered,
)
from tests.benchmarks.detector.lighting import BAND
from tests.benchmarks.detector.models import (
    CHANGE_CLAIM,
    CHANGED,
    COVER,
    DARK,
    DIM,
    SECOND,
    dim,
    faint_found,
    false_in_dark,
    size_claims_after_change,
)
from tests.benchmarks.detector.pictures import flat, paste, sight_of
from tests.benchmarks.detector.recall import SIZE
from tests.benchmarks.detector.second.measurement import measure_cell
from tests.benchmarks.detector.table import Run
from tests.camera_node.tracing import ellipse_of

RUN = Run("chords", Detector, False)
MILD_SHARE = 0.8  # goal for covered roundels behind a mild camera
CARDS = 90  # in three pictures
FALLS_OFF = Sensor(noise=1.5, vignetting=0.3, shading=0.2)
MIDDLE = (np.array(SIZE[::-1]) - 1) / 2


@cache
def known(sensor: Camera) -> Detector:
    """A detector that has learned the response of a camera."""
    return acquainted(RUN, sensor)


@pytest.fixture
def mild() -> Detector:
    return known(MILD)


@pytest.mark.parametrize(("tone", "exponent"), [("linear", 1.0), ("gamma", 2.2)])
def test_the_tone_curve_is_learned_from_the_known_ratio(tone, exponent):
    """The print's ratio is known to 0.002, which is 5 % of the exponent for the roundels of these pictures."""
    detector = known(Sensor(noise=2.0, tone=tone))
    assert detector.tone_exponent == pytest.approx(exponent, rel=0.05)


def test_a_detector_with_other_settings_keeps_what_it_learned_about_the_camera(mild: Detector):
    assert mild.tone_exponent is not None
    assert mild.adjusted(min_contrast=20.0).tone_exponent == mild.tone_exponent > 1.5


@pytest.mark.parametrize(("sensor", "share"), [(Sensor(tone="gamma"), 0.75), (MILD, 0.7), (HARSH, 0.4)])
def test_one_picture_shows_what_its_camera_does_to_covered_roundels(sensor: Sensor, share: float):
    """Roundels that are all covered show tone curve and processing together. The first frame had 2 % of them."""
    assert share_found(Detector(), sensor, partial(covered, 0.2, False), 2) > share


@pytest.mark.ci
def test_one_picture_shows_a_filmic_curve_and_light_that_falls_off():
    """46 % were found: an exponent at its limit counted as exact, covered roundels did not teach the light, and the
    curve hid where cards end."""
    show = replace(SECOND["harsh camera"], cover=COVER).show
    assert measure_cell(Detector(), show, BAND, 4).found > 0.6


@pytest.mark.parametrize(("before", "after"), [("gamma 2.2", "linear"), ("linear", "gamma 2.2")])
def test_a_camera_that_changes_is_claimed_at_once_and_known_in_ten_frames(before: str, after: str):
    """Sizes are 1 to 2 % off in the first frame, 1,200 to 1,700 times the claim if what was learned is obeyed."""
    first, *_, last = size_claims_after_change(RUN, CHANGED[before], CHANGED[after])
    assert first < CHANGE_CLAIM
    assert last < CHANGE_CLAIM / 2  # 3 if only the claims follow


def test_a_camera_that_changes_teaches_nothing_about_the_prints():
    """Prints do not change: their ratio of 0.600 became 0.591 in the first frame of another tone curve, and with that
    its exponent of 2.2 was measured as 2.46, the greatest one in use."""
    rng, detector = np.random.default_rng(0), Detector()
    light = paste(flat(SIZE, 90.0), cards(rng, 24, 60))
    for _ in range(3):
        detector.detect(CHANGED["linear"].expose(light, rng))
    for _ in range(2):
        detector.detect(CHANGED["gamma 2.2"].expose(light, rng))
        assert detector.found_ratios == pytest.approx([0.6], abs=0.002)
    assert detector.tone_exponent == pytest.approx(2.2, rel=0.05)


def test_contrast_is_judged_before_the_picture_is_made_linear():
    """Ink of 47 and paper of 88 differ by 18 linear levels: a detector that knows the tone curve finds them, too."""
    assert faint_found(Detector(), 1) == faint_found(known(Sensor(tone="gamma")), 1) == 1


@pytest.mark.parametrize(
    "sensor",
    [
        Sensor(noise=2.0, tone="gamma"),
        Sensor(noise=2.0, vignetting=0.5),
        Sensor(noise=2.0, shading=0.5),
        Sensor(noise=3.0, denoise_px=1.0),
        Sensor(noise=2.0, jpeg=80),
        MILD,
    ],
    ids=["gamma", "vignetting", "shading", "denoising", "JPEG", "mild"],
)
@pytest.mark.parametrize("band", [(14, 20), pytest.param((32, 60), marks=pytest.mark.ci)])
def test_centre_and_size_are_within_their_claims(sensor: Sensor, band):
    """The issue's goal is three times the claimed variance; without the model it was 10 to 30 times."""
    measured: Errors = errors(known(sensor), sensor, band, 2)
    assert measured.found > 0.97
    assert measured.centre < 3
    assert measured.size < 3


@pytest.mark.parametrize("change", [{"tone": "webcam"}, {"sharpen": 0.8}], ids=["S-shaped", "sharpened"])
def test_what_no_exponent_describes_is_within_the_claims(change):
    """Before the curvature that is left was an unknown, sizes had 13 and 5 times the claimed variance."""
    sensor = msgspec.structs.replace(MILD, **change)
    measured: Errors = errors(known(sensor), sensor, (20, 32), 2)
    assert measured.found > 0.9
    assert measured.centre < 3
    assert measured.size < 3


class Film(Sensor, frozen=True):
    """A sensor whose tone curve has a shoulder: sRGB, of which the upper 30 % are compressed."""

    def expose(self, light: Array, rng: np.random.Generator) -> Grey:
        """The picture (h, w), uint8, of light (h, w)."""
        return FILM[super().expose(light, rng)]


def film() -> Grey:
    """(256,) encoded level of each linear level."""
    encoded = 1.055 * (1.3 * np.arange(256) / 255) ** (1 / 2.4) - 0.055
    over = np.maximum(encoded - 0.7, 0) / 0.3
    return np.rint(255 * np.maximum(np.minimum(encoded, 0.7) + 0.3 * (1 - np.exp(-over)), 0)).astype(np.uint8)


FILM = film()


@pytest.mark.parametrize("band", [(14, 20), (32, 60)])
def test_roundels_are_found_and_claimed_behind_a_curve_with_a_shoulder(band):
    """Light falls off, so that each roundel has another part of the curve."""
    sensor = Film(noise=1.5, vignetting=0.5, shading=0.5)
    measured: Errors = errors(known(sensor), sensor, band, 2)
    assert measured.found > 0.97
    assert measured.centre < 3
    assert measured.size < 3


@pytest.mark.parametrize(
    ("from_rim", "goal"), [pytest.param(False, MILD_SHARE, marks=pytest.mark.ci), (True, 0.9)]
)
def test_covered_roundels_are_found_behind_a_mild_camera(mild: Detector, from_rim, goal):
    """A fifth of the diameter is covered. Four binomial standard deviations of the goal are subtracted."""
    share = share_found(mild, MILD, partial(covered, 0.2, from_rim), CARDS // 30)
    assert share > goal - 4 * np.sqrt(goal * (1 - goal) / CARDS)


@pytest.mark.ci
def test_a_camera_that_denoises_and_sharpens_is_learned():
    """Flat areas hide what processing does at edges. Before it was learned, no covered roundel was found.

    The goal is a third from the rim; four binomial standard deviations are subtracted.
    """
    detector, goal = known(HARSH), 1 / 3
    assert detector.tone_exponent is not None
    share = share_found(detector, HARSH, partial(covered, 0.2, True), CARDS // 30)
    assert share > goal - 4 * np.sqrt(goal * (1 - goal) / CARDS)


@pytest.mark.parametrize(
    "level", [2.0, *(pytest.param(level, marks=pytest.mark.ci) for level in (5.0, 15.0))]
)
@pytest.mark.parametrize("camera", DARK.values(), ids=DARK.keys())
def test_noise_of_dark_places_makes_no_roundels(camera: Camera, level: float):
    """A tone curve amplifies it, a mosaic and denoising correlate it: up to three in a frame were found, because
    smooth noise explains the residuals of its own rings. One in 10,000 frames is due."""
    for detector in (Detector(), known(camera)):
        assert false_in_dark(detector, camera, level, 4) == 0


def test_noise_of_a_dim_room_hides_no_roundels():
    """A limit of six deviations of the noise refused 9 in 10, once the tone curve was known, and noise that counted as
    8 grey levels at most 1 in 5 in the first picture, where it has 9 to 22."""
    for detector in (Detector(), known(DIM)):
        assert share_found(detector, DIM, dim, 2) > 0.9


def test_small_prints_among_textures_are_no_noise():
    """A picture without flat places does not show how strong its noise is: a limit that took textures for noise refused
    15 of these 100 prints, and 76 were found. The goal is 0.9; a binomial deviation is 0.03."""
    first, _ = pictures.measure(
        pictures.SCENES["second, mild"], pictures.SMALL, pictures.SMALL_TILT, False, 100, 1
    )
    assert first.shown == 100
    assert first.found > 100 * (0.9 - 3 * 0.03)


def test_one_picture_of_a_harsh_camera_shows_what_its_small_prints_need():
    """Rings that were refused before the tone curve was known are judged once more: of prints of 11 to 14 px 72 % were
    found, and 0.88 are due, with a binomial deviation of 0.027."""
    first, _ = pictures.measure(
        pictures.SCENES["first, harsh"], pictures.SMALL, pictures.SMALL_TILT, False, 144, 1
    )
    assert first.found > first.shown * (0.88 - 3 * 0.027)


@pytest.mark.parametrize("paper", [pytest.param(308.0, marks=pytest.mark.ci), 410.0])
def test_clipped_paper_is_found(paper):
    clean = Sensor(noise=3.0)
    assert share_found(known(clean), clean, partial(over_exposed, paper), 3) > 0.97


@pytest.mark.parametrize("band", [(20, 32), (32, 60)])
def test_the_size_of_over_exposed_prints_is_claimed_before_the_tone_curve_is_known(band):
    """Clipped paper does not show the curve: squared errors were 116 and 358 times the variances of sizes."""
    assert errors(Detector(), Sensor(tone="gamma", gain=1.5, noise=2.0), band, 2).size < 3


@pytest.mark.parametrize(("jpeg", "band"), [(None, (20, 32)), (90, (32, 60))])
def test_compressed_levels_of_clipped_paper_are_lower_bounds(jpeg, band):
    """They counted as the paper's level: squared errors were 299 and 197 times the variances of sizes."""
    measured = errors(Detector(), Sensor(tone="gamma", gain=1.9, noise=2.0, jpeg=jpeg), band, 2)
    assert measured.found > 0.97
    assert measured.centre < 3
    assert measured.size < 3


def test_the_light_that_falls_off_towards_the_corners_is_learned():
    """On clutter a roundel shows little of it; without the camera's fall-off centres lie 0.01 px outwards."""
    outwards = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        light, cards = uncovered(rng)
        found = known(FALLS_OFF).adjusted().detect(FALLS_OFF.expose(light, rng))
        for card in cards:
            k = int(np.linalg.norm(found.uv - card.uv, axis=1).argmin())
            away = (np.array(card.uv) - MIDDLE) / 320
            outwards.append((found.uv[k] - ellipse_of(sight_of(card, (SIZE[1], SIZE[0])))[0]) @ away)
    mean, sigma = np.mean(outwards), np.std(outwards) / np.sqrt(len(outwards))
    assert abs(mean) < 3 * sigma + 0.001
