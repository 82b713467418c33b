# SPDX-License-Identifier: BSD-3-Clause
"""The detector on rendered images: accurate, with a consistent covariance, and without false positives."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from camera_node import _core
from camera_node.detection.detector import Detector
from camera_node.foundation.errors import ConfigError
from tests.benchmarks.detector.pictures import Card, F, outline_of, render
from tests.camera_node.tracing import expose


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


@pytest.mark.parametrize("diameter", [14, 24, 40])
@pytest.mark.parametrize("tilt_deg", [0, 30, 50])
@pytest.mark.parametrize("blur", [0.5, 1.0])
def test_without_noise_only_rounding_errors_remain(diameter: float, tilt_deg: float, blur: float):
    """Centre within 0.02 px (rounding to grey levels has a standard deviation of 0.29), axes 1.5 %, ratio 0.02."""
    for u, v in rng().uniform(50, 70, (3, 2)):
        disc = Card((u + 20, v), diameter, np.radians(tilt_deg), turn=0.7)
        if diameter * np.cos(disc.tilt) < 5.5 + 8 * blur:
            continue  # blur hides the card's margin, a seventh of this
        (found,) = Detector().detect(expose(render([disc], blur=blur), 0, rng()))
        centre, axes = outline_of(disc)
        assert np.abs(found.uv - centre).max() < 0.02
        assert np.allclose(found.axes_px, axes, rtol=0.015)
        assert abs(found.ratio - 0.6) < 0.02


def test_reported_covariance_is_consistent():
    """Squared Mahalanobis errors have mean 2; the mean of 200 has the standard deviation 0.14, four are allowed.

    A quarter more is allowed for the first-order model at 16 px.
    """
    generator, squared = rng(), []
    for turn in np.linspace(0, 3, 10):
        disc = Card((80.3 + turn, 60.6), 16 + turn, 0.6, turn)
        clean, (centre, _) = render([disc]), outline_of(disc)
        for _ in range(20):
            (found,) = Detector().detect(expose(clean, 3, generator))
            error = found.uv - centre
            squared.append(error @ np.linalg.solve(found.cov, error))
    assert 2 - 0.56 < np.mean(squared) < 2 * 1.25 + 0.56


def test_the_inner_ellipse_gives_the_centre_of_the_disc():
    """At 60 px and 45 degrees it is 1 px from the ellipse's centre; the measured offset is within four sigmas."""
    disc = Card((80.2, 60.4), 60, np.radians(45), turn=0.4)
    (found,) = Detector().detect(expose(render([disc]), 1, rng()))
    offset, cov = found.offset_px, found.pose_cov
    assert offset is not None
    assert cov is not None
    error = found.uv + offset - disc.uv
    assert np.linalg.norm(offset) > 0.5
    from_centre = cov[:2, :2] + cov[:2, 5:] + cov[5:, :2] + cov[5:, 5:]
    assert error @ np.linalg.solve(from_centre, error) < 16 + 2


def test_shadow_and_gradient():
    """The light decreases to 0.4 across the image, and a shadow halves it in a part."""
    discs = [Card((25 + 45 * i, 25 + 40 * j), 22) for i in range(3) for j in range(2)]
    light = np.tile(np.linspace(1, 0.4, 160), (120, 1))
    light[:, 48:92] *= 0.5
    found = Detector().detect(expose(light * render(discs, bright=230), 2, rng()))
    assert len(found) == 6


def test_adjacent_roundels_do_not_disturb_each_other():
    discs = [Card((20 + 24 * i, 20 + 24 * j), 14) for i in range(6) for j in range(4)]
    found = Detector().detect(expose(render(discs), 2, rng()))
    apart = np.linalg.norm(found.uv[:, None] - [disc.uv for disc in discs], axis=2)
    assert len(found) == 24
    assert apart.min(axis=1).max() < 0.1


@pytest.mark.parametrize("ratio", [0.6, 0.41, 0.35])
def test_the_common_prints_are_found_by_default(ratio: float):
    assert len(Detector().detect(expose(render([Card((80, 60), 30, ratio=ratio)]), 2, rng()))) == 1


def test_a_roundel_on_a_dark_round_plate_is_found():
    """One dark ring around a card may be a plate below it; two make a bullseye."""
    card = render([Card((80, 60), 30)], ground=40)
    v, u = np.mgrid[:120, :160]
    plate = np.where(np.hypot(u - 80, v - 60) < 30, card, 150)
    assert len(Detector().detect(expose(plate, 2, rng()))) == 1


def bullseye(image: np.ndarray) -> None:
    for radius in (45, 27, 12):
        cv2.circle(image, (80, 60), radius, 40.0, 6, cv2.LINE_AA)


def small_dot(image: np.ndarray) -> None:
    cv2.circle(image, (80, 60), 25, 40.0, -1)
    cv2.circle(image, (80, 60), 4, 190.0, -1)


def tag_in_disc(image: np.ndarray) -> None:
    cv2.circle(image, (80, 60), 30, 40.0, -1)
    cv2.rectangle(image, (68, 48), (92, 72), 190.0, -1)


def square(image: np.ndarray) -> None:
    cv2.rectangle(image, (60, 40), (100, 80), 40.0, -1)
    cv2.circle(image, (80, 60), 12, 190.0, -1)


def letters(image: np.ndarray) -> None:
    fonts = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_COMPLEX, cv2.FONT_HERSHEY_TRIPLEX)
    for k, font in enumerate(fonts):
        cv2.putText(image, "oO08Qg@e", (4, 30 + 35 * k), font, 0.6 + 0.2 * k, 40.0, 1 + k, cv2.LINE_AA)


@pytest.mark.parametrize("draw", [bullseye, small_dot, tag_in_disc, square, letters])
def test_other_shapes_are_not_found(draw):
    image = np.full((120, 160), 190, np.uint8)
    draw(image)
    for blur in (0.5, 1.0):
        seen = cv2.GaussianBlur(image.astype(float), (0, 0), blur)
        assert len(Detector().detect(expose(seen, 2, rng()))) == 0


@pytest.mark.parametrize("line", [cv2.LINE_8, cv2.LINE_AA])
@pytest.mark.parametrize("blur", [0.0, 0.4, 0.7])
@pytest.mark.parametrize("radius", [8, 12, 20, 40, 80, 150])
def test_drawn_circles_are_found(line: int, blur: float, radius: int):
    """Circles drawn by OpenCV, with edges as sharp as the pixel grid; drawing rounds them to half a pixel."""
    image = np.full((480, 640), 220, np.uint8)
    cv2.circle(image, (320, 240), radius, 20.0, -1, line)
    cv2.circle(image, (320, 240), round(0.6 * radius), 220.0, -1, line)
    if blur:
        image = cv2.GaussianBlur(image, (0, 0), blur)
    (found,) = Detector().detect(image.astype(np.uint8))
    assert np.abs(found.uv - [320, 240]).max() < 0.1
    assert np.abs(found.axes_px - (2 * radius + 0.5)).max() < 1


def test_clutter_that_touches_the_card_costs_no_accuracy():
    """A bright and a dark bar across the surround: the error of the centre is below 0.05 px, a few sigmas."""
    disc = Card((80.3, 59.8), 24, 0.5, 0.3)
    image = render([disc], blur=0)
    image[:, 95:99] = 250
    image[75:80] = 20
    (found,) = Detector().detect(expose(cv2.GaussianBlur(image, (0, 0), 0.7), 2, rng()))
    assert np.abs(found.uv - outline_of(disc)[0]).max() < 0.05


def test_a_track_stays_with_its_roundel():
    detector, numbers = Detector(), []
    for k in range(4):
        discs = [Card((30 + 5 * k, 40), 20), Card((120 - 5 * k, 80), 20)]
        found = detector.detect(expose(render(discs), 2, rng()))
        numbers.append(found.track[np.argsort(found.uv[:, 1])].tolist())
    assert numbers == [numbers[0]] * 4
    assert len(set(numbers[0])) == 2
    far = detector.detect(expose(render([Card((80, 20), 20)]), 2, rng()))
    assert far.track[0] not in numbers[0]


def test_a_masked_roundel_is_discarded():
    image = expose(render([Card((40, 60), 20), Card((120, 60), 20)]), 2, rng())
    found = Detector(mask=[[(0, 0), (80, 0), (80, 119), (0, 119)]]).detect(image)
    assert found.uv[:, 0] == pytest.approx([120], abs=0.1)


def test_the_result_does_not_depend_on_the_memory_layout():
    image = expose(render([Card((80, 60), 20, 0.4)]), 2, rng())
    wide = np.zeros((240, 400), np.uint8)
    wide[::2, 100:260] = image
    views = (wide[::2, 100:260], np.asfortranarray(image))
    for view in views:
        assert np.array_equal(Detector().detect(view).uv, Detector().detect(image).uv)


@settings(max_examples=60)
@given(
    height=st.integers(0, 40),
    width=st.integers(0, 70),
    seed=st.integers(0, 1000),
    levels=st.sampled_from([1, 2, 256]),
)
def test_any_image_gives_finite_results(height: int, width: int, seed: int, levels: int):
    """Sizes from 0 x 0; constant, black and white, or random pixels."""
    image = rng(seed).integers(0, levels, (height, width)).astype(np.uint8) * np.uint8(255 // levels)
    found = Detector(min_contrast=5).detect(image)
    assert np.isfinite(found.uv).all()
    assert np.isfinite(found.cov).all()


@pytest.mark.parametrize(
    "wrong",
    [
        {"detector": "napa"},
        {"inner_ratios": (0.6,) * 17},
        {"inner_ratios": (1.2,)},
        {"ratio_tolerance": 0.0},
        {"min_diameter_px": 50.0, "max_diameter_px": 40.0},
        {"min_contrast": 0.0},
        {"min_contrast": float("nan")},
        {"mask": [[(0, 0), (1, 1)]]},
    ],
)
def test_a_wrong_setting_is_refused(wrong: dict):
    with pytest.raises(ConfigError):
        Detector(**wrong)


def test_an_image_that_is_not_grey_is_refused():
    with pytest.raises(ValueError, match="grey"):
        Detector().detect(np.zeros((4, 4, 3), np.uint8))


def test_theta_of_the_papers_detector():
    """Section III-B: theta = (m_d + m_b) / 2 after one frame, within a level; it steps while nothing is found."""
    detector = Detector(detector="paper")
    detector.detect(expose(render([Card((80, 60), 40)]), 1, rng()))
    assert detector.threshold == pytest.approx((40 + 190) / 2, abs=1)
    flat = np.full((120, 160), 90, np.uint8)
    steps = []
    for _ in range(7):
        detector.detect(flat)
        steps.append(detector.threshold)
    assert len(set(steps)) == 7
    assert 0 < min(steps) <= 32
    assert 224 <= max(steps) < 256


def test_only_the_papers_detector_has_a_threshold():
    detector = Detector()
    detector.detect(expose(render([Card((80, 60), 40)]), 1, rng()))
    assert detector.threshold is None


def test_distance_by_the_principal_axis():
    """Section III-C: at any tilt the major axis in the normalized plane gives the distance; exact for frontal discs."""
    for tilt in np.radians([0, 30, 60]):
        disc = Card((79.5, 59.5), 30, tilt)
        major = outline_of(disc)[1][0] / F
        distance = _core.distance_by_principal_axis(disc.diameter / F, major)
        assert distance == pytest.approx(1.0, abs=(disc.diameter / F) ** 2)
    with pytest.raises(ValueError, match="above 0"):
        _core.distance_by_principal_axis(0.1, 0.0)


def test_a_known_roundel_may_be_partly_occluded():
    """A bar as bright as paper covers the outer fifth. A new ring of this shape is rejected as a letter."""
    disc = Card((80.3, 59.8), 36, 0.3, 0.4)
    clean = render([disc], blur=0)
    covered = clean.copy()
    covered[:, 94:101] = 190
    detector, generator = Detector(), rng()
    (seen,) = detector.detect(expose(cv2.GaussianBlur(clean, (0, 0), 0.7), 2, generator))
    frame = expose(cv2.GaussianBlur(covered, (0, 0), 0.7), 2, generator)
    (still,) = detector.detect(frame)
    assert still.track == seen.track
    assert np.abs(still.uv - seen.uv).max() < 0.1
