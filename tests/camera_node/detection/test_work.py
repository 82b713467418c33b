# SPDX-License-Identifier: BSD-3-Clause
"""Bounded work per frame: search shares, the limit on fits, and settings that change between frames."""

import numpy as np
import pytest
from numpy.typing import NDArray

from camera_node.detection.detector import Detector
from camera_node.foundation.errors import ConfigError
from tests.benchmarks.detector.pictures import Card, render
from tests.camera_node.tracing import expose


def frame(*discs: Card, seed: int = 1) -> NDArray[np.uint8]:
    return expose(render(list(discs), bright=200), 2, np.random.default_rng(seed))


@pytest.mark.parametrize("share", [0.5, 0.25, 0.1])
@pytest.mark.parametrize("begin", range(4))
def test_a_search_share_finds_every_new_roundel(share: float, begin: int):
    """At any position and any time of the cycle, a new roundel is found within 1 / share frames."""
    plain, rounds = frame(), round(1 / share)
    for v in (16.0, 40.0, 60.0, 80.0, 104.0):
        detector, shown = Detector(search_share=share), frame(Card((80, v), 24))
        for _ in range(rounds + begin):
            detector.detect(plain)
        assert any(len(detector.detect(shown)) for _ in range(rounds))


def test_tracked_roundels_are_found_in_every_frame():
    detector, discs = Detector(search_share=0.1), [Card((40, 20), 20), Card((120, 100), 20)]
    shown = frame(*discs)
    while len(detector.detect(shown)) < 2:
        pass
    assert [len(detector.detect(frame(*discs, seed=k))) for k in range(20)] == [2] * 20


@pytest.fixture(scope="module")
def crowd() -> NDArray[np.uint8]:
    """2,700 roundels of 12 px, 20 px apart."""
    tile = render([Card((9.5, 9.5), 12)], (20, 20), bright=210, ground=210, blur=0.6)
    return expose(np.tile(tile, (45, 60)), 1, np.random.default_rng(1))


def test_the_fits_of_a_frame_are_limited_and_all_seeds_are_fitted(crowd: NDArray[np.uint8]):
    """At most 512 new seeds per frame: six frames are enough for all, and then none is postponed."""
    detector = Detector()
    results = [detector.detect(crowd) for _ in range(7)]
    counts = [len(found) for found in results]
    assert counts[0] <= 512
    assert results[-1].n_postponed == 0
    assert counts[-1] > 0.99 * 2700
    assert np.diff(counts).max() <= 512
    assert all(np.diff(counts[:4]) > 256)


def test_postponed_seeds_are_counted(crowd: NDArray[np.uint8]):
    detector = Detector()
    assert detector.detect(frame(Card((80, 60), 24))).n_postponed == 0
    assert detector.detect(crowd).n_postponed > 1000


def test_new_settings_preserve_the_tracks():
    discs = [Card((40, 60), 20), Card((120, 60), 30)]
    detector = Detector()
    before = detector.detect(frame(*discs))
    changed = detector.adjusted(min_contrast=40.0)
    after = changed.detect(frame(*discs, seed=2))
    assert changed.settings == {**detector.settings, "min_contrast": 40.0}
    assert dict(zip(before.track.tolist(), np.rint(before.uv[:, 0]), strict=True)) == dict(
        zip(after.track.tolist(), np.rint(after.uv[:, 0]), strict=True)
    )
    new = changed.adjusted(max_diameter_px=25.0).detect(frame(*discs, Card((80, 100), 20), seed=3))
    assert set(new.track.tolist()) - set(before.track.tolist()) == {2}


def test_a_wrong_change_is_refused():
    with pytest.raises(ConfigError, match="min_contrast"):
        Detector().adjusted(min_contrast=0.0)
