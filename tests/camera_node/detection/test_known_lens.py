# SPDX-License-Identifier: BSD-3-Clause
"""Outlines that are conditioned on the lens: exact, more precise than free ones, and no worse with a wrong lens."""

from dataclasses import dataclass

import cv2
import msgspec
import numpy as np
import pytest

from camera_node.detection.detector import Detector
from camera_node.detection.known_lens import MIN_SIGMA, KnownLens
from camera_node.detection.roundels import DetectedRoundels
from camera_node.foundation.arrays import Array
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.lens import Lens
from tests.camera_node.tracing import Sight, ellipse_of, pixels_across, shape_of, trace

SIDE = 60  # of a picture that is a part of the sensor, pixels
PINHOLE = Lens(width=SIDE, height=SIDE, fx=600.0, fy=600.0, cx=230.0, cy=-120.0)
DISTORTED = msgspec.structs.replace(PINHOLE, distortion=(-0.25, 0.1, 0.001, -0.002))
FISHEYE = msgspec.structs.replace(PINHOLE, distortion=(0.05, -0.01, 0.0, 0.0), model="fisheye")
NOISE = 3.0


def picture_of(sight: Sight) -> DetectedRoundels:
    """The exact measurement of a disc through a lens without distortion, with a usual covariance."""
    centre, S = shape_of(sight)
    (minor2, major2), v = np.linalg.eigh(S)
    sigma = np.array([0.006, 0.006, 0.004, 0.004, 0.004, 0.02, 0.02])
    one = np.ones(1)
    return DetectedRoundels(
        uv=centre[None],
        cov=np.eye(2)[None] * sigma[0] ** 2,
        axes_px=2 * np.sqrt([[major2, minor2]]),
        angle_rad=np.arctan2(v[1:, 1], v[:1, 1]),
        ratio=0.6 * one,
        contrast=150 * one,
        id=np.full(1, -1, np.int32),
        track=np.full(1, -1, np.int32),
        offset_px=(np.array(sight.uv) - centre)[None],
        pose_cov=np.diag(sigma**2)[None],
    )


def sight_at(lens: Lens, diameter_px: float, tilt_deg: float, turn: float, shift: float = 0.0) -> Sight:
    middle = (SIDE - 1) / 2 + shift
    distance = pixels_across(lens, 0.1, diameter_px)
    tilt = float(np.radians(tilt_deg))
    # On white the edge of the card, which would determine the perspective, is invisible.
    return Sight(lens, (middle, middle - shift / 2), distance, tilt=tilt, turn=turn, ground=190.0)


@pytest.mark.parametrize("tilt_deg", [0.0, 5.0, 30.0, 70.0])
def test_an_exact_measurement_stays(tilt_deg: float):
    """The true pose explains it, so nothing changes beyond the convergence of 0.03 standard deviations (0.006 px)."""
    exact = picture_of(sight_at(PINHOLE, 30, tilt_deg, 1.0))
    refined, chi2 = KnownLens(PINHOLE).constrain(exact)
    assert chi2[0] < 1e-2
    np.testing.assert_allclose(refined.uv, exact.uv, atol=2e-4 if tilt_deg else 2e-3)
    np.testing.assert_allclose(refined.axes_px, exact.axes_px, atol=4e-4)


def test_the_claim_shrinks_and_stays_positive_definite():
    exact = picture_of(sight_at(PINHOLE, 30, 40, 2.0))
    exact.pose_cov[:, 0, 5] = exact.pose_cov[:, 5, 0] = -0.8 * 0.006 * 0.02  # as fits have it
    exact.pose_cov[:, 1, 6] = exact.pose_cov[:, 6, 1] = -0.8 * 0.006 * 0.02
    refined, _ = KnownLens(PINHOLE).constrain(exact)
    values = np.linalg.eigvalsh(refined.cov[0])
    assert values[0] > 0
    assert values[1] < 0.6 * exact.cov[0, 0, 0]  # 1 - 0.8^2 is what an exact offset leaves


def outline_centre(sight: Sight) -> Array:
    """(2,) centre of the ellipse that is fitted to the image of the outer circle through any lens."""
    first = np.cross(sight.normal, [1.0, 0.0, 0.0])
    first /= np.linalg.norm(first)
    second = np.cross(sight.normal, first)
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)[:, None]
    rim = sight.position + sight.diameter_m / 2 * (np.cos(angle) * first + np.sin(angle) * second)
    # In units of a pixel around the middle: cv2 computes with single precision.
    uv = sight.lens.project(rim)
    centre, *_ = cv2.fitEllipseDirect((uv - sight.uv).astype(np.float32))
    return np.array(centre) + sight.uv


@dataclass(frozen=True)
class Scores:
    """Mean squared errors of the free and the constrained centres, squared pixels, and the latter over its claim."""

    free: float
    constrained: float
    claim: float
    chi2: float


def score(known: KnownLens, sights: list[Sight], draws: int) -> Scores:
    """Errors of detections in `draws` exposures of each view, in an order in which all views alternate."""
    rng = np.random.default_rng(4)
    clean, true = [trace(s, 4) for s in sights], [outline_centre(s) for s in sights]
    rows = []
    for _ in range(draws):
        for image, centre in zip(clean, true, strict=True):
            noisy = np.clip(np.round(image + NOISE * rng.standard_normal(image.shape)), 0, 255)
            found = Detector(inner_ratios=[0.6]).detect(noisy.astype(np.uint8))
            _, chi2 = known.constrain(found)
            refined = known.refine(found)
            free, off = found.uv[0] - centre, refined.uv[0] - centre
            claim = off @ np.linalg.solve(refined.cov[0], off) / 2
            rows.append((free @ free / 2, off @ off / 2, claim, chi2[0] / 2))
    return Scores(*np.nanmean(rows, axis=0))


def views_of(lens: Lens, diameters: tuple[float, ...] = (16.0, 30.0)) -> list[Sight]:
    return [
        sight_at(lens, d, tilt, turn, shift)
        for d in diameters
        for tilt, turn, shift in ((20.0, 0.4, 0.3), (45.0, 2.0, -0.2), (35.0, 4.5, 0.1), (55.0, 5.6, 0.4))
    ]


@pytest.mark.parametrize("lens", [PINHOLE, DISTORTED, FISHEYE], ids=["pinhole", "distorted", "fisheye"])
def test_centres_are_more_precise_and_honest_through_any_lens(lens: Lens):
    """Tilted roundels gain 25 to 40 % of a standard deviation. 160 squared errors over claims, each of two
    coordinates, have a mean of 1 +- 0.08; small roundels' claims are of first order."""
    known = KnownLens(lens)
    scores = score(known, views_of(lens), 20)
    assert scores.constrained < 0.8 * scores.free
    assert 0.7 < scores.claim < 1.4
    assert 0.5 < scores.chi2 < 1.5
    assert known.sigma < 5 * MIN_SIGMA
    assert not known.contradicted


@pytest.mark.parametrize(
    ("seen", "assumed"),
    [
        (PINHOLE, msgspec.structs.replace(PINHOLE, fx=603.0, fy=603.0)),
        (DISTORTED, PINHOLE),
        (PINHOLE, msgspec.structs.replace(PINHOLE, fx=400.0, fy=480.0, cx=SIDE / 2)),
    ],
    ids=["focal length 0.5 % wrong", "distortion not known", "another camera's"],
)
def test_a_wrong_lens_is_no_worse_than_none(seen: Lens, assumed: Lens):
    """Errors stay those of the free fit, and within the claim, after some frames have shown the contradiction."""
    known, sights = KnownLens(assumed), views_of(seen, (16.0, 40.0))
    score(known, sights, 3)
    scores = score(known, sights, 10)
    assert scores.constrained < 1.05 * scores.free
    assert scores.claim < 1.3  # 1 +- 0.11, and 1.6 with another camera's lens that is trusted


def test_another_lens_is_recognized():
    known = KnownLens(msgspec.structs.replace(PINHOLE, fx=400.0, fy=480.0, cx=SIDE / 2))
    score(known, views_of(PINHOLE, (40.0,)), 8)
    assert known.contradicted


def test_what_cannot_be_computed_stays_as_measured():
    """Where the lens has no inverse, and where numbers are NaN, huge or contradict each other."""
    exact = picture_of(sight_at(PINHOLE, 30, 30, 1.0))
    folded = msgspec.structs.replace(PINHOLE, distortion=(-40.0, 0.0, 0.0, 0.0))
    known = KnownLens(folded)
    refined, chi2 = known.constrain(exact)
    np.testing.assert_array_equal(refined.uv, exact.uv)
    assert np.isnan(chi2).all()
    for broken in (np.nan, np.inf, -1.0, 1e300):
        exact = picture_of(sight_at(PINHOLE, 30, 30, 1.0))
        exact.pose_cov[:] = broken
        exact.axes_px[:] *= broken
        refined = KnownLens(PINHOLE).refine(exact)
        np.testing.assert_array_equal(refined.uv, exact.uv)
    assert len(KnownLens(PINHOLE).refine(exact.select(np.zeros(0, int)))) == 0


def test_a_tilted_sensor_is_refused():
    with pytest.raises(ConfigError, match="tilted sensor"):
        KnownLens(msgspec.structs.replace(PINHOLE, distortion=(0.0,) * 12 + (0.01, 0.0)))


def test_the_true_centre_of_a_pinhole_agrees_with_the_dual_conic():
    sight = sight_at(PINHOLE, 40, 50, 1.0)
    np.testing.assert_allclose(outline_centre(sight), ellipse_of(sight)[0], atol=1e-4)
