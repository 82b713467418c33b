# SPDX-License-Identifier: BSD-3-Clause
"""Codes: their words differ as defined, and what is drawn and rendered is what the words say."""

import math

import numpy as np
import pytest

from camera_node.geometry import codes
from camera_node.geometry.body import Body

DISTANCE = 4


def turns(word: int) -> np.ndarray:
    """(SECTORS,) the word at all turns."""
    n = codes.SECTORS
    return np.array([((word << s) | (word >> (n - s))) & ((1 << n) - 1) for s in range(n)])


def mirrored(word: int) -> int:
    return int(format(word, f"0{codes.SECTORS}b")[::-1], 2)


def test_words_differ_in_four_sectors_at_all_turns_and_from_mirror_images():
    """A name and a turn are wrong only where more than one sector is, and a mirrored print has none."""
    all_turns = np.array([turns(word) for word in codes.words()])
    for k, word in enumerate(codes.words()):
        apart = np.bitwise_count(all_turns ^ word)
        apart[k, 0] = codes.SECTORS  # itself
        assert apart.min() >= DISTANCE
        assert np.bitwise_count(all_turns ^ mirrored(word)).min() >= DISTANCE
        assert np.bitwise_count(word ^ np.array([0, (1 << codes.SECTORS) - 1])).min() >= DISTANCE
        assert len(codes.arcs(k + 1)) >= 3
    assert len(codes.words()) >= 64


def test_no_word_can_be_added():
    """The lexicode is complete: each other word is too near to one of its words, or is no possible one."""
    all_turns = np.array([turns(word) for word in codes.words()]).ravel()
    rng = np.random.default_rng(3)
    for word in rng.integers(0, 1 << codes.SECTORS, 300).tolist():
        own, image = turns(word), turns(mirrored(word))
        black, arcs = int(np.bitwise_count(word)), int(np.bitwise_count(word ^ own[1])) // 2
        is_possible = (
            min(black, codes.SECTORS - black) >= DISTANCE
            and arcs >= 3
            and np.bitwise_count(word ^ own[1:]).min() >= DISTANCE
            and np.bitwise_count(word ^ image).min() >= DISTANCE
        )
        near = min(np.bitwise_count(all_turns ^ word).min(), np.bitwise_count(all_turns ^ image[0]).min())
        assert not is_possible or near < DISTANCE


def test_arcs_and_shares_state_the_same_sectors():
    angles = (np.arange(20 * codes.SECTORS) + 0.5) * codes.STEP / 20
    for code in range(1, len(codes.words()) + 1):
        share = codes.black_share(code, angles, np.full(len(angles), 1e-9))
        inside = [
            any(a < x < b or a < x + math.tau < b for a, b in codes.arcs(code)) for x in angles.tolist()
        ]
        assert np.array_equal(share > 0.5, inside)
        assert np.abs(share - share.round()).max() < 1e-9


def test_the_share_of_an_extended_part_is_the_mean_of_its_points():
    angle, width, offsets = 1.234, 0.8, (np.arange(10000) + 0.5) / 10000 - 0.5
    points = codes.black_share(5, angle + width * offsets, np.full(10000, 1e-9))
    assert codes.black_share(5, np.array([angle]), np.array([width]))[0] == pytest.approx(
        points.mean(), abs=2e-4
    )


@pytest.mark.parametrize(
    ("code", "message"),
    [
        (98, "there is no code 98; give 1 to 97"),
        (-1, "there is no code -1; give 1 to 97"),
        ((1, 2), "2 codes for 1 markers; give one for each"),
    ],
)
def test_impossible_codes_are_refused(code: int | tuple[int, ...], message: str):
    with pytest.raises(ValueError, match=message):
        Body(diameter_m=0.1, code=code)


def test_a_code_is_on_one_marker_of_a_body():
    markers = ((0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.0, 0.2, 0.0))
    with pytest.raises(ValueError, match="the same code"):
        Body(diameter_m=0.1, markers=markers, code=(7, 7, 0))
    assert Body(diameter_m=0.1, markers=markers, code=(7, 0, 0)).codes == (7, 0, 0)
    assert Body(diameter_m=0.1, markers=markers).codes == (0, 0, 0)
