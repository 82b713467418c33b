# SPDX-License-Identifier: BSD-3-Clause
"""A fixed camera's detector searches what changed, and finds there what a search of the whole frame finds."""

import numpy as np
import pytest

from camera_node.arrays import Array
from camera_node.detection.detector import Detector
from tests.benchmarks.detector.pictures import Card, Grey, dead_leaves, expose, flat, missed, paste

SIZE = (240, 320)
TRUST = 16  # frames in which what does not change is searched once
GROUNDS = {
    "white": lambda rng: flat(SIZE, 190.0),
    "grey": lambda rng: flat(SIZE, 110.0),
    "clutter": lambda rng: dead_leaves(SIZE, rng),
}


def show(ground: Array, cards: list[Card], seed: int, dark: float = 40.0) -> Grey:
    return expose(paste(ground, cards, dark=dark), 3.0, np.random.default_rng(seed))


def watcher(ground: Array) -> Detector:
    """A detector that has seen a scene without roundels for some frames."""
    detector = Detector()
    for seed in range(3):
        detector.detect(show(ground, [], seed))
    return detector


@pytest.mark.parametrize("name", GROUNDS)
@pytest.mark.parametrize("dark", [40.0, 95.0])
def test_what_appears_is_found_in_its_first_frame(name: str, dark: float):
    """Wherever, from the smallest size on, of full contrast and of less: as a first frame's search does."""
    rng = np.random.default_rng(7)
    ground = GROUNDS[name](rng)
    at_once = at_first = 0
    for seed in range(12):
        places = rng.uniform((20, 20), (SIZE[1] - 20, SIZE[0] - 20), (1, 2)).tolist()
        cards = [Card((u, v), float(rng.uniform(10, 40)), float(rng.uniform(0, 0.7))) for u, v in places]
        shown = show(ground, cards, 10 + seed, dark)
        at_once += missed(cards, watcher(ground).detect(shown).uv) == 0
        at_first += missed(cards, Detector().detect(shown).uv) == 0
    assert at_once >= at_first > 9


def test_what_a_search_missed_is_looked_for_again_although_nothing_changes():
    """Twelve that a search finds by luck: none in the first frame, and then some when all is searched again."""
    ground, cards = (
        flat(SIZE, 190.0),
        [Card((60.3 + 50 * (k % 4), 60.4 + 50 * (k // 4)), 9.0) for k in range(12)],
    )
    detector = Detector()
    found = [len(detector.detect(show(ground, cards, 2 + k, dark=166.0))) for k in range(3 * TRUST + 1)]
    assert not any(found[:TRUST])
    assert any(found)


def test_one_that_comes_back_where_it_was_is_found():
    """Hidden for a frame or for many, then as before; and what uncovers it may be as dark as the ring."""
    ground, card = dead_leaves(SIZE, np.random.default_rng(3)), [Card((160.3, 120.4), 24.0)]
    for level, hidden in ((40.0, 1), (120.0, 5), (220.0, 40)):
        detector, covered = watcher(ground), paste(ground, card)
        covered[100:140, 140:180] = level
        first = detector.detect(show(ground, card, 1))
        for seed in range(hidden):
            assert len(detector.detect(expose(covered, 3.0, np.random.default_rng(seed)))) == 0
        again = detector.detect(show(ground, card, 2))
        assert missed(card, first.uv) == missed(card, again.uv) == 0


def test_slow_changes_add_up():
    """What comes by a fortieth a frame is found two frames at most after a first frame's search would find it."""
    ground, card = flat(SIZE, 190.0), [Card((100.3, 80.4), 30.0)]
    detector, seen = watcher(ground), []
    for k in range(40):
        mixed = (1 - k / 40) * paste(ground, []) + k / 40 * paste(ground, card)
        frame = expose(mixed, 2.0, np.random.default_rng(k))
        seen.append((len(detector.detect(frame)), len(Detector().detect(frame))))
    watched, first = (np.flatnonzero(column)[0] for column in np.array(seen).T)
    assert watched <= first + 2
    assert all(count == 1 for count, _ in seen[watched:])
