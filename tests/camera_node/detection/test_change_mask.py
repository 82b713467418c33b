# SPDX-License-Identifier: BSD-3-Clause
"""The detector of a fixed camera searches the changed parts of a frame and finds all that a full search finds."""

import numpy as np
import pytest

from camera_node.detection.detector import Detector
from camera_node.foundation.arrays import Array
from tests.benchmarks.detector.pictures import Card, Grey, dead_leaves, expose, flat, missed, paste

SIZE = (240, 320)
INTERVAL = 16  # frames between two searches of unchanged parts
GROUNDS = {
    "white": lambda rng: flat(SIZE, 190.0),
    "grey": lambda rng: flat(SIZE, 110.0),
    "clutter": lambda rng: dead_leaves(SIZE, rng),
}


def show(ground: Array, cards: list[Card], seed: int, dark: float = 40.0) -> Grey:
    return expose(paste(ground, cards, dark=dark), 3.0, np.random.default_rng(seed))


def warm_detector(ground: Array) -> Detector:
    """A detector that has processed some frames of a scene without roundels."""
    detector = Detector()
    for seed in range(3):
        detector.detect(show(ground, [], seed))
    return detector


@pytest.mark.parametrize("name", GROUNDS)
@pytest.mark.parametrize("dark", [40.0, 95.0])
def test_a_new_roundel_is_found_in_its_first_frame(name: str, dark: float):
    """At any position, of any size and contrast, at least as often as a new detector finds it."""
    rng = np.random.default_rng(7)
    ground = GROUNDS[name](rng)
    warm = cold = 0
    for seed in range(12):
        places = rng.uniform((20, 20), (SIZE[1] - 20, SIZE[0] - 20), (1, 2)).tolist()
        cards = [Card((u, v), float(rng.uniform(10, 40)), float(rng.uniform(0, 0.7))) for u, v in places]
        shown = show(ground, cards, 10 + seed, dark)
        warm += missed(cards, warm_detector(ground).detect(shown).uv) == 0
        cold += missed(cards, Detector().detect(shown).uv) == 0
    assert warm >= cold > 9


def test_unchanged_parts_are_searched_again_after_an_interval():
    """Twelve roundels near the limit: none is found in the first frame, some in later searches of all of the image."""
    cards = [Card((60.3 + 50 * (k % 4), 60.4 + 50 * (k // 4)), 9.0) for k in range(12)]
    light = paste(flat(SIZE, 60.0), cards, dark=36.0, bright=60.0)
    detector = Detector(inner_ratios=(0.6,))  # otherwise the second frame is searched for other prints
    frames = [expose(light, 3.0, np.random.default_rng(2 + k)) for k in range(3 * INTERVAL + 1)]
    found = [len(detector.detect(frame)) for frame in frames]
    assert not any(found[:INTERVAL])
    assert any(found)


def test_a_roundel_that_returns_to_its_place_is_found():
    """It is hidden for one frame or for many, by an object that may be as dark as the ring."""
    ground, card = dead_leaves(SIZE, np.random.default_rng(3)), [Card((160.3, 120.4), 24.0)]
    for level, hidden in ((40.0, 1), (120.0, 5), (220.0, 40)):
        detector, covered = warm_detector(ground), paste(ground, card)
        covered[100:140, 140:180] = level
        first = detector.detect(show(ground, card, 1))
        for seed in range(hidden):
            assert len(detector.detect(expose(covered, 3.0, np.random.default_rng(seed)))) == 0
        again = detector.detect(show(ground, card, 2))
        assert missed(card, first.uv) == missed(card, again.uv) == 0


def test_slow_changes_accumulate():
    """A roundel that fades in over 40 frames is found at most two frames later than by a new detector."""
    ground, card = flat(SIZE, 190.0), [Card((100.3, 80.4), 30.0)]
    detector, counts = warm_detector(ground), []
    for k in range(40):
        mixed = (1 - k / 40) * paste(ground, []) + k / 40 * paste(ground, card)
        frame = expose(mixed, 2.0, np.random.default_rng(k))
        counts.append((len(detector.detect(frame)), len(Detector().detect(frame))))
    warm, cold = (np.flatnonzero(column)[0] for column in np.array(counts).T)
    assert warm <= cold + 2
    assert all(count == 1 for count, _ in counts[warm:])
