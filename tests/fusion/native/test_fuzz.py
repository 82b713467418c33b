# SPDX-License-Identifier: BSD-3-Clause
"""The native core with invalid input: wrong arrays are refused, hostile numbers cause no access out of bounds."""

import contextlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fusion import _core
from tests.conftest import ROOT
from tests.native import fuzz

NATIVE = ROOT / "fusion" / "native"


@pytest.mark.slow
def test_random_numbers_do_not_break_the_core(tmp_path: Path):
    """Empty arrays, NaN, infinities, denormal and huge numbers, under AddressSanitizer and UBSan."""
    driver = Path(__file__).with_name("fuzz.cpp")
    assert fuzz(NATIVE, driver, 5000, tmp_path, ("address", "undefined", "float-cast-overflow")) == (0, "")


B, F, N = 3, 2, 5
FRAME, BODY = np.array([0, 0, 0, 1, 1]), np.array([0, 1, 2, 1, 0])
P, R = np.tile(np.eye(12), (B, 1, 1)), np.tile(np.eye(3), (B, 1, 1))
BODY_ARRAYS = R, np.zeros((B, 3)), np.zeros((B, 3)), np.zeros((B, 3))
EXPOSURE_ARRAYS = np.tile(np.eye(3), (F, 1, 1)), -2 * np.ones((F, 3)), np.zeros(F), np.zeros(F)
ALONG_Z = np.tile([[0.0], [0.0], [1.0]], N)
DISC_ARRAYS = FRAME, BODY, np.zeros((3, N)), ALONG_Z, np.full(N, 0.0625), np.full(N, 0.0625)
SCALES, FOCAL, FALSE = np.tile(np.eye(2)[..., None], N), np.full(F, 800.0), np.zeros(B, bool)
DETECTION_ARRAYS = FRAME, np.zeros((2, N)), SCALES, SCALES, np.ones(N), np.ones(N), np.ones(N)
VIEWPOINT_ARRAYS = np.arange(F), np.zeros((F, 3))
VIEWPOINTS = _core.Viewpoints(*VIEWPOINT_ARRAYS)
POSES = _core.FramePoses(_core.BodyStates(*BODY_ARRAYS), _core.CameraExposures(*EXPOSURE_ARRAYS))
MARKERS = _core.ExpectedMarkers(R, P, BODY, BODY, *DISC_ARRAYS[2:5])
OUTLINES = np.ones((2, N)), np.zeros(N), SCALES, np.ones(N)


def of_discs(method: Callable[..., np.ndarray], *rest: np.ndarray) -> tuple[Callable[..., np.ndarray], tuple]:
    """A method whose first argument is given by the arrays of the discs."""
    return lambda *given: method(_core.DiscColumns(*given[:6]), *given[6:]), (*DISC_ARRAYS, *rest)


def undistorted(cells: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """The columns that `undistort` writes in place; arrays with another layout are refused."""
    _core.undistort(cells, 32.0, 1e-3, columns)
    return columns


CALLS = {
    "BodyStates": (_core.BodyStates, BODY_ARRAYS),
    "CameraExposures": (_core.CameraExposures, EXPOSURE_ARRAYS),
    "DiscColumns": (_core.DiscColumns, DISC_ARRAYS),
    "views": of_discs(POSES.views),
    "linearize_centres": of_discs(POSES.linearize_centres, np.zeros((2, N)), SCALES, FALSE),
    "linearize_outlines": of_discs(POSES.linearize_outlines, *OUTLINES),
    "DetectionColumns": (_core.DetectionColumns, DETECTION_ARRAYS),
    "ExpectedMarkers": (
        lambda R, P, body, *shapes: _core.ExpectedMarkers(R, P, body, BODY, *shapes),
        (R, P, BODY, *DISC_ARRAYS[2:5]),
    ),
    "candidates": (
        lambda *given: MARKERS.candidates(POSES, _core.DetectionColumns(*given[:7]), given[7]),
        (*DETECTION_ARRAYS, FOCAL),
    ),
    "assign": (
        lambda pairs, cost: _core.assign(pairs, cost, FRAME),
        (np.stack([BODY, np.arange(N)]), np.zeros(N)),
    ),
    "shears": (
        _core.shears,
        (np.ones((2, N)), np.zeros(N), np.ones((3, N)), np.ones((3, N)), np.ones(N), SCALES),
    ),
    "FramePoses": (
        lambda *given: _core.FramePoses(_core.BodyStates(*given[:4]), _core.CameraExposures(*given[4:])),
        (*BODY_ARRAYS, *EXPOSURE_ARRAYS),
    ),
    "predict": (
        lambda *given: _core.predict(_core.BodyStates(*given[:4]), *given[4:]),
        (*BODY_ARRAYS, P, np.full(B, 1 / 64), np.ones((B, 2)), FALSE),
    ),
    "BodyFit": (
        lambda *given: _core.BodyFit(
            _core.BodyStates(*given[:4]),
            _core.CameraExposures(*given[4:8]),
            _core.DiscColumns(*given[8:14]),
            *given[14:-1],
        ).linearize(given[-1]),
        (
            *(*BODY_ARRAYS, *EXPOSURE_ARRAYS, *DISC_ARRAYS, np.zeros((2, N)), SCALES, FALSE, *OUTLINES),
            *(np.ones(N, bool), np.ones(N, bool), np.zeros((N, 2, 13)), P, np.zeros((N, 2, 13))),
        ),
    ),
    "whiten": (_core.whiten, (SCALES, SCALES)),
    "squared_px": (_core.squared_px, (np.ones((N, 2)), SCALES, SCALES)),
    "are_own": (
        _core.are_own,
        (
            *(np.ones((N, 2, 13)), SCALES, np.ones(N), BODY, FRAME, np.zeros(N, bool), P),
            *(BODY, FRAME, FRAME, np.zeros(N), np.zeros(N)),
        ),
    ),
    "inverses": (_core.inverses, (P,)),
    "Viewpoints": (_core.Viewpoints, VIEWPOINT_ARRAYS),
    "densest_ranges": (
        _core.densest_ranges,
        (VIEWPOINTS, FRAME, np.ones((N, 3)), np.ones(N), np.zeros(N), np.ones((N, 1, 2))),
    ),
    "ray_pairs": (
        lambda frames, frame, d, reach, moved, ranges: _core.ray_pairs(
            frames, frame, d, reach, moved, ranges, 2.0
        ),
        (VIEWPOINTS, FRAME, np.ones((N, 3)), np.ones(N), np.zeros(N), np.ones((N, 1, 2))),
    ),
    "undistort": (lambda cells: undistorted(cells, np.ones((19, N))), (np.zeros((4, 5, 20)),)),
}
# Constructors check the indices only where they know what the indices refer to; `are_own` only compares cameras.
UNCHECKED = {"DiscColumns", "DetectionColumns", "are_own"}
ANY_LENGTH = {"inverses", "Viewpoints", "undistort"}  # functions of arrays whose lengths are independent


def alike(array: np.ndarray):
    """The same numbers with another type, stride or order in memory."""
    yield array.astype(np.float32 if array.dtype == float else np.int32)
    yield np.repeat(array, 2, axis=-1)[..., ::2]
    yield np.asfortranarray(array)
    yield np.ascontiguousarray(array[::-1])[::-1]


def numbers_of(result: object) -> list[np.ndarray]:
    """The arrays of a result; none of an object of the core."""
    parts = result if isinstance(result, tuple) else (result,)
    return [part for part in parts if isinstance(part, np.ndarray)]


@pytest.mark.parametrize("name", CALLS)
def test_the_memory_layout_of_arrays_does_not_matter(name: str):
    function, given = CALLS[name]
    expected = numbers_of(function(*given))
    for k, array in enumerate(given):
        for same in alike(array) if isinstance(array, np.ndarray) else ():
            np.testing.assert_equal(numbers_of(function(*given[:k], same, *given[k + 1 :])), expected)


@pytest.mark.parametrize("name", CALLS)
def test_arrays_of_wrong_shape_or_length_are_refused(name: str):
    """The core does not read beyond their ends."""
    function, given = CALLS[name]
    for k, array in enumerate(given):
        if not isinstance(array, np.ndarray):
            continue
        for wrong in (array[None], array.astype("U8"), None):
            with pytest.raises(TypeError):
                function(*given[:k], wrong, *given[k + 1 :])
        for axis in range(array.ndim if name not in ANY_LENGTH else 0):
            short = np.ascontiguousarray(np.delete(array, -1, axis))
            with pytest.raises((TypeError, ValueError, IndexError)):
                function(*given[:k], short, *given[k + 1 :])


def test_an_array_that_would_be_copied_is_not_written():
    """What the core writes in place would be lost."""
    for array in (*alike(np.ones((19, N))), np.ones((18, N))):
        with pytest.raises(TypeError):
            undistorted(np.zeros((4, 5, 20)), array)


@pytest.mark.parametrize("length", [0, 1, 23, 25])
def test_columns_of_a_message_of_different_lengths_are_refused(length: int):
    columns = [bytes(n) for n in (32, 24, 16, 8, 8, 8, 8, 8)]
    assert _core.detection_columns(*columns).shape == (19, 2)
    for k in range(1, len(columns)):
        if k > 4 and length == 0:  # no codes
            continue
        given = [bytes(length) if i == k else column for i, column in enumerate(columns)]
        with pytest.raises(ValueError, match="lengths"):
            _core.detection_columns(*given)


@pytest.mark.parametrize("name", sorted(CALLS.keys() - UNCHECKED))
def test_indices_out_of_range_are_refused(name: str):
    function, given = CALLS[name]
    for k, array in enumerate(given):
        if isinstance(array, np.ndarray) and array.dtype == np.int64:
            for wrong in (-1, 1 << 40):
                spoiled = array.copy()
                spoiled.flat[-1] = wrong
                with pytest.raises(IndexError):
                    function(*given[:k], spoiled, *given[k + 1 :])


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e308, 0.0])
@pytest.mark.parametrize("name", CALLS)
def test_hostile_numbers_do_not_crash(name: str, value: float):
    """They give hostile numbers or an exception."""
    function, given = CALLS[name]
    for k, array in enumerate(given):
        if isinstance(array, np.ndarray) and array.dtype == float:
            with contextlib.suppress(RuntimeError, ValueError):
                function(*given[:k], np.full_like(array, value), *given[k + 1 :])


@pytest.mark.parametrize("name", ["views", "linearize_centres", "linearize_outlines", "candidates", "shears"])
def test_no_detections_give_no_columns(name: str):
    function, given = CALLS[name]
    none = [a[..., :0].copy() if isinstance(a, np.ndarray) and a.shape[-1] == N else a for a in given]
    assert all(0 in part.shape for part in numbers_of(function(*none)))


@pytest.mark.parametrize("name", ["FramePoses", "predict", "inverses"])
def test_no_bodies_give_no_rows(name: str):
    function, given = CALLS[name]
    assert all(0 in part.shape for part in numbers_of(function(*(a[:0].copy() for a in given))))
