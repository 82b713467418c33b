# SPDX-License-Identifier: BSD-3-Clause
"""The size of a wand, from a file with errors and from its shape."""

from collections.abc import Callable

import numpy as np
import pytest

from calib.wand.bundle_adjustment.problem import AffineWand
from calib.wand.quality.wand_shape import infer_size
from camera_node.foundation.arrays import Array
from camera_node.geometry.body import Body

LINE = np.array([[0.0, 0, 0], [0.2, 0, 0], [0.5, 0, 0]])
ANGLE = np.array([[0.0, 0, 0], [0.4, 0, 0], [0.1, 0.25, 0]])
PLANE = np.vstack([ANGLE, [0.33, 0.13, 0]])
SOLID = np.vstack([ANGLE, [0.15, 0.1, 0.2]])
NOISE_M = 5e-5  # of the measured shape
TRIALS = 200


def wand_of(points: Array) -> AffineWand:
    return AffineWand.of(Body(diameter_m=0.1, markers=tuple(map(tuple, points.tolist()))))


def wrong_everywhere(points: Array, rng: np.random.Generator) -> Array:
    """All markers by 1 mm, within their line, plane or space."""
    dimension = np.linalg.matrix_rank(points - points[0])
    return np.pad(rng.normal(scale=1e-3, size=(len(points), dimension)), ((0, 0), (0, 3 - dimension)))


def wrong_once(points: Array, rng: np.random.Generator) -> Array:
    """One marker by 4 mm."""
    errors, dimension = np.zeros_like(points), np.linalg.matrix_rank(points - points[0])
    direction = rng.normal(size=dimension)
    errors[rng.integers(len(points)), :dimension] = 4e-3 * direction / np.linalg.norm(direction)
    return errors


def infer(points: Array, errors: Array, rng: np.random.Generator) -> tuple[float, float]:
    """The error of the size that follows from a file with errors, relative, and its claimed standard deviation."""
    wand, off = wand_of(points + errors), points + errors - (points + errors).mean(axis=0)
    n = len(wand.shapes)
    shape = -np.tensordot(wand.shapes, errors, 2) + NOISE_M * rng.normal(size=n)
    size, sigma = infer_size(wand.points, wand.shapes, shape, NOISE_M**2 * np.eye(n))
    return size - 1 + float((off * errors).sum() / (off**2).sum()), sigma


@pytest.mark.parametrize("points", [LINE, ANGLE, PLANE, SOLID], ids=["line", "angle", "plane", "solid"])
@pytest.mark.parametrize("wrong", [wrong_everywhere, wrong_once])
def test_the_size_is_as_wrong_as_it_claims(
    points: Array, wrong: Callable[[Array, np.random.Generator], Array]
):
    """Of normal errors, 68 % are within the claim. The prior, uniform in the logarithm of the errors, knows less than
    this test, so more may be within; 3 deviations of the share of 200 trials are 10 %."""
    rng = np.random.default_rng(1)
    off, claimed = np.array([infer(points, wrong(points, rng), rng) for _ in range(TRIALS)]).T
    assert 0.53 < (np.abs(off) < claimed).mean() < 0.9
    assert np.median(np.abs(off)) > 0.2 * np.median(claimed)


@pytest.mark.parametrize("points", [PLANE, SOLID], ids=["plane", "solid"])
def test_one_wrong_marker_of_four_is_found(points: Array):
    """4 mm of 0.4 m are up to 1 % of the size; the noise of the shape, 0.05 mm, is 0.02 %."""
    rng = np.random.default_rng(2)
    off, claimed = np.array([infer(points, wrong_once(points, rng), rng) for _ in range(TRIALS)]).T
    assert np.sqrt((off**2).mean()) < 2 * NOISE_M / np.linalg.norm(points - points.mean(axis=0)) * 2
    assert claimed.max() < 1e-3


@pytest.mark.parametrize("points", [LINE, ANGLE, PLANE, SOLID], ids=["line", "angle", "plane", "solid"])
def test_a_right_file_is_hardly_uncertain(points: Array):
    """By less than a fiftieth of a percent, and it is wrong by less than the noise of the shape."""
    rng = np.random.default_rng(3)
    off, claimed = np.array([infer(points, np.zeros_like(points), rng) for _ in range(TRIALS)]).T
    assert np.median(claimed) < 2e-4
    assert np.abs(off).max() < NOISE_M / np.linalg.norm(points - points.mean(axis=0))


def test_shapes_neither_move_nor_turn_nor_scale():
    """To first order: no displacement of a shape is along one of these seven."""
    wand = wand_of(SOLID)
    off = SOLID - SOLID.mean(axis=0)
    turns = [np.cross(axis, off) for axis in np.eye(3)]
    moves = [np.tile(axis, (len(off), 1)) for axis in np.eye(3)]
    for motion in (*turns, *moves, off):
        assert np.tensordot(wand.shapes, motion, 2) == pytest.approx(np.zeros(5), abs=1e-12)
    assert len(wand_of(LINE).shapes) == 1
    assert len(wand_of(LINE[:2]).shapes) == len(wand_of(LINE[:1]).shapes) == 0


def test_derivatives_by_the_shape_are_those_of_the_wand():
    """Against central differences of the weights and of the lengths."""
    wand, step = wand_of(PLANE), 1e-6
    by_weights, by_lengths = wand.jacobians()
    for k, unit in enumerate(np.eye(len(wand.shapes))):
        there, here = wand.displaced(step * unit), wand.displaced(-step * unit)
        assert by_weights[k] == pytest.approx((there.weights - here.weights) / (2 * step), abs=1e-6)
        assert by_lengths[k] == pytest.approx((there.lengths - here.lengths) / (2 * step), abs=1e-6)
