# SPDX-License-Identifier: BSD-3-Clause
"""The native core on what it was not made for: wrong arrays are refused, wild numbers stay within their arrays."""

import contextlib
from pathlib import Path

import numpy as np
import pytest

from fusion import _core
from tests.conftest import ROOT
from tests.native import fuzz

NATIVE = ROOT / "fusion" / "native"


@pytest.mark.slow
def test_no_numbers_break_the_core(tmp_path: Path):
    """Empty arrays, NaN, infinities, denormal and huge numbers, under AddressSanitizer and UBSan."""
    driver = Path(__file__).with_name("fuzz.cpp")
    assert fuzz(NATIVE, driver, 5000, tmp_path, ("address", "undefined", "float-cast-overflow")) == (0, "")


B, F, N = 3, 2, 5
FRAME, BODY = np.array([0, 0, 0, 1, 1]), np.array([0, 1, 2, 1, 0])
EYES, TURNS = np.tile(np.eye(12), (B, 1, 1)), np.tile(np.eye(3), (B, 1, 1))
BODIES = TURNS, np.zeros((B, 3)), np.zeros((B, 3)), np.zeros((B, 3))
EXPOSURES = np.tile(np.eye(3), (F, 1, 1)), -2 * np.ones((F, 3)), np.zeros(F)
DISCS = FRAME, BODY, np.zeros((3, N)), np.full(N, 0.0625)
SCALES, FOCAL, FALSE = np.tile(np.eye(2)[..., None], N), np.full(F, 800.0), np.zeros(B, bool)
ROWS, STEPS = np.zeros((N, 2, 13)), np.zeros((B, 12))
POSES = _core.Poses(*BODIES, *EXPOSURES)
MARKERS = _core.ExpectedMarkers(TURNS, EYES, BODY, DISCS[2], DISCS[3])
CALLS = {
    "Poses": (_core.Poses, (*BODIES, *EXPOSURES)),
    "view": (POSES.view, DISCS),
    "linearise": (POSES.linearise, (*DISCS, np.zeros((2, N)), SCALES, FALSE)),
    "linearise_outlines": (
        POSES.linearise_outlines,
        (*DISCS, np.ones((2, N)), np.zeros(N), SCALES, np.ones(N)),
    ),
    "ExpectedMarkers": (_core.ExpectedMarkers, (TURNS, EYES, BODY, DISCS[2], DISCS[3])),
    "candidates": (MARKERS.candidates, (POSES, FRAME, np.zeros((2, N)), SCALES, SCALES, np.ones(N), FOCAL)),
    "shears": (
        _core.shears,
        (np.ones((2, N)), np.zeros(N), np.ones((3, N)), np.ones((3, N)), np.ones(N), SCALES),
    ),
    "predict": (_core.predict, (*BODIES, EYES, np.full(B, 1 / 64), np.ones((B, 2)), FALSE)),
    "reweigh": (_core.reweigh, (ROWS, BODY, EYES, STEPS, np.ones(N))),
    "remainder": (_core.remainder, (ROWS, BODY, STEPS)),
    "inverses": (_core.inverses, (EYES,)),
    "densest_ranges": (
        _core.densest_ranges,
        (np.arange(F), np.zeros((F, 3)), np.zeros(F), FRAME, np.ones((N, 3)), np.ones(N), np.ones((N, 1, 2))),
    ),
    "look_up": (_core.look_up, (np.zeros((4, 5, 20)), 32.0, np.zeros((N, 2)))),
}
ALONE = {"inverses", "look_up"}  # whose number of rows is anybody's choice


def alike(array: np.ndarray):
    """The same numbers otherwise in memory: of another kind, in other steps, the other way round."""
    yield array.astype(np.float32 if array.dtype == float else np.int32)
    yield np.repeat(array, 2, axis=-1)[..., ::2]
    yield np.asfortranarray(array)
    yield np.ascontiguousarray(array[::-1])[::-1]


def numbers_of(result: object) -> list[np.ndarray]:
    """What is compared of a result; of an object of the core nothing."""
    parts = result if isinstance(result, tuple) else (result,)
    return [part for part in parts if isinstance(part, np.ndarray)]


@pytest.mark.parametrize("name", CALLS)
def test_arrays_that_lie_otherwise_in_memory_are_read_as_the_numbers_that_they_hold(name: str):
    function, given = CALLS[name]
    expected = numbers_of(function(*given))
    for k, array in enumerate(given):
        for same in alike(array) if isinstance(array, np.ndarray) else ():
            np.testing.assert_equal(numbers_of(function(*given[:k], same, *given[k + 1 :])), expected)


@pytest.mark.parametrize("name", CALLS)
def test_arrays_of_another_shape_or_length_are_refused(name: str):
    """Rather than read beyond their ends."""
    function, given = CALLS[name]
    for k, array in enumerate(given):
        if not isinstance(array, np.ndarray):
            continue
        for wrong in (array[None], array.astype("U8"), None):
            with pytest.raises(TypeError):
                function(*given[:k], wrong, *given[k + 1 :])
        for axis in range(array.ndim if name not in ALONE else 0):
            short = np.ascontiguousarray(np.delete(array, -1, axis))
            with pytest.raises((TypeError, ValueError, IndexError)):
                function(*given[:k], short, *given[k + 1 :])


@pytest.mark.parametrize("name", CALLS)
def test_indices_that_name_nothing_are_refused(name: str):
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
def test_wild_numbers_do_no_harm(name: str, value: float):
    """They give numbers as wild, or an error that says so."""
    function, given = CALLS[name]
    for k, array in enumerate(given):
        if isinstance(array, np.ndarray) and array.dtype == float:
            with contextlib.suppress(RuntimeError, ValueError):
                function(*given[:k], np.full_like(array, value), *given[k + 1 :])


@pytest.mark.parametrize("name", ["view", "linearise", "linearise_outlines", "candidates", "shears"])
def test_of_no_detections_there_are_no_columns(name: str):
    function, given = CALLS[name]
    none = [a[..., :0].copy() if isinstance(a, np.ndarray) and a.shape[-1] == N else a for a in given]
    assert all(0 in part.shape for part in numbers_of(function(*none)))


@pytest.mark.parametrize("name", ["Poses", "predict", "reweigh", "remainder", "inverses"])
def test_of_no_bodies_there_are_no_rows(name: str):
    function, given = CALLS[name]
    assert all(0 in part.shape for part in numbers_of(function(*(a[:0].copy() for a in given))))
