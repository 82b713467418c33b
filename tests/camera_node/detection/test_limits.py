# SPDX-License-Identifier: BSD-3-Clause
"""The detector against its goals (a part of `python -m tests.benchmarks.detector`); agreement of both detectors."""

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from camera_node.detection.detector import Detector, DetectorSettings, SettingKeywords
from camera_node.geometry.lens import Lens
from tests.benchmarks.detector.accuracy import Errors, measure_cell
from tests.benchmarks.detector.bound import bound
from tests.benchmarks.detector.cells import Cell
from tests.benchmarks.detector.negatives import clutter
from tests.benchmarks.detector.pictures import Card, outline_of, render
from tests.benchmarks.detector.recall import faint, of_size, recall
from tests.benchmarks.detector.table import Run
from tests.camera_node.tracing import Sight, expose, pixels_across

RUN = Run("chords", Detector, False)
VIEWS, DRAWS = 4, 40
CHANCE = 1 + 4 / np.sqrt(2 * VIEWS * DRAWS)  # four sigmas of the RMS of so many errors


@pytest.mark.parametrize("blur", [0.7, 1.0])
@pytest.mark.parametrize("diameter", [20, 50])
def test_the_bound_of_a_frontal_disc_is_that_of_its_edges(diameter: float, blur: float):
    """The Fisher information of a step C, blurred by s and moved by 1 px, is C^2 / (2 sqrt(pi) s) per pixel of edge.

    For an unknown lens the centre of a frontal disc follows from its outer edge, of which cos^2 = 1/2 moves along u.
    The distance follows from both edges, which it moves by their radii. It is correlated with blur and levels, which
    increases its variance by 5 % to 22 % here.
    """
    side = int(1.4 * diameter + 20)
    lens = Lens(width=side, height=side, fx=600, fy=600, cx=side / 2, cy=side / 2)
    distance = pixels_across(lens, 0.1, diameter)
    limit = bound(Sight(lens, (side / 2, side / 2), distance, blur=blur, ground=190.0), 6)
    outer, inner = diameter / 2, 0.6 * diameter / 2
    per_pixel = 150**2 / (2 * np.sqrt(np.pi) * np.sqrt(blur**2 + 1 / 12)) / (3**2 + 1 / 12)
    centre, size = np.pi * outer * per_pixel, 2 * np.pi * (outer**3 + inner**3) * per_pixel
    assert limit.centre_variance(3, knows_lens=False) == pytest.approx(1 / centre, rel=0.03)
    assert 0.98 < limit.distance_variance(3) * size < 1.25


@pytest.fixture(
    scope="module",
    params=[
        (16, 30, 3.0, 0.7),
        *(pytest.param(cell, marks=pytest.mark.ci) for cell in ((30, 45, 3.0, 1.0), (40, 15, 1.0, 0.5))),
    ],
)
def errors(request: pytest.FixtureRequest) -> Errors:
    return measure_cell(RUN, Cell(*request.param), VIEWS, DRAWS)


def test_the_centre_is_near_the_bound_for_an_unknown_lens(errors: Errors):
    """The goal is 1.15 times the bound; four sigmas are added."""
    assert errors.found == 1
    assert errors.detected < 1.15 * CHANCE


def test_the_distance_is_near_its_bound_and_unbiased(errors: Errors):
    """The goals are 1.5 times the bound and 0.05 %; four and three sigmas are added."""
    assert errors.distance < 1.5 * CHANCE
    assert not errors.biased


def test_the_reported_covariance_is_consistent(errors: Errors):
    """Half the squared Mahalanobis error has mean 1: within four sigmas, plus a fifth for the model."""
    assert abs(errors.chi2 - 1) < 0.2 + 4 / np.sqrt(VIEWS * DRAWS)


@pytest.mark.parametrize(
    ("ground", "tilt", "diameter"), [("white", 0, 9), ("white", 45, 12), ("clutter", 0, 16), ("dark", 0, 12)]
)
def test_small_roundels_are_found_on_the_first_frame(ground: str, tilt: int, diameter: int):
    """The goal is 99 %: of 120 roundels 1.2 may be missed, plus four sigmas."""
    assert recall(RUN, 2, of_size(ground, diameter, tilt)) > 1 - (1.2 + 4 * np.sqrt(1.2)) / 120


def test_faint_roundels_are_found():
    """The goal is 95 %, less four sigmas of 90 roundels."""
    assert recall(RUN, 3, faint) > 0.95 - 4 * np.sqrt(0.05 * 0.95 / 90)


def test_nothing_is_found_in_clutter():
    assert sum(len(Detector().detect(picture)) for picture in clutter(6)) == 0


@st.composite
def scenes(draw: st.DrawFn) -> tuple[list[Card], float, float, int]:
    """One to four separate roundels, their bright level, the blur and a seed for the noise."""
    places = draw(
        st.lists(
            st.sampled_from([(40.0, 30.0), (120.0, 30.0), (40.0, 90.0), (120.0, 90.0)]),
            min_size=1,
            unique=True,
        )
    )
    discs = [
        Card(
            (u + draw(st.floats(-3, 3)), v + draw(st.floats(-3, 3))),
            draw(st.floats(16, 34)),
            draw(st.floats(0, 0.7)),
            draw(st.floats(0, 6.2)),
            ratio=draw(st.sampled_from([0.6, 0.41])),
        )
        for u, v in places
    ]
    return discs, draw(st.floats(120, 230)), draw(st.floats(0.5, 0.9)), draw(st.integers(0, 99))


LEAST_ALIKE = [
    Card(uv=(118.25, 27.234375), diameter=19.765625, tilt=0.5625, turn=6.0),
    *(Card(uv=uv, diameter=16.0) for uv in ((40.0, 30.0), (40.0, 90.0), (120.0, 90.0))),
]


@settings(max_examples=15)
@given(scenes())
@example((LEAST_ALIKE, 133.0, 0.75, 1))
def test_both_detectors_agree(scene: tuple[list[Card], float, float, int]):
    """Both find every roundel; their fits have different initial guesses and the same result.

    A one-step estimate does not depend on its initial guess to first order: their difference is below one sigma of the
    less certain one, since each claims the correlation of its own residuals. Errors are below four sigmas plus 0.02 px
    for rounding.
    """
    discs, bright, blur, seed = scene
    image = expose(render(discs, bright=bright, blur=blur), 2, np.random.default_rng(seed))
    by_paper, by_chords = (Detector(detector=name).detect(image) for name in ("paper", "chords"))
    assert len(by_paper) == len(by_chords) == len(discs)
    for disc in discs:
        centre = outline_of(disc)[0]
        ours, theirs = (r[int(np.linalg.norm(r.uv - centre, axis=1).argmin())] for r in (by_chords, by_paper))
        sigma, other = (float(np.sqrt(np.trace(found.cov) / 2)) for found in (ours, theirs))
        assert np.abs(ours.uv - theirs.uv).max() < max(sigma, other)
        assert np.abs(ours.uv - centre).max() < 4 * sigma + 0.02


def test_the_keywords_of_the_detector_are_its_settings():
    """Editors and type checkers read `SettingKeywords`; `DetectorSettings` is what the detector uses."""
    assert set(SettingKeywords.__annotations__) == {field.name for field in fields(DetectorSettings)}
