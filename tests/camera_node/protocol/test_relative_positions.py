# SPDX-License-Identifier: BSD-3-Clause
"""Relative positions are decoded as they were encoded, and impossible ones are refused."""

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from camera_node.protocol.messages import (
    MAX_POSITIONS,
    MessageError,
    RelativePositions,
    decode,
    encode,
)
from tests.camera_node.protocol.positions import HEADER, pack_random, random_positions

GOOD = pack_random(2)


@given(st.integers(0, 9), st.integers(0, 2**32 - 1))
def test_positions_are_decoded_as_they_were_encoded(n: int, seed: int):
    """Positions and covariances to the bit; the other columns are float32, of values up to 9."""
    sent = random_positions(n, seed)
    got = decode(encode(RelativePositions.pack(sent, **HEADER)), RelativePositions).unpack()
    for name in ("position", "cov", "id", "track"):
        assert np.array_equal(
            getattr(got, name), getattr(sent, name) if name != "cov" else symmetric(sent.cov)
        )
    for name in ("normals", "probability", "normal_sigma", "axis_distance"):
        np.testing.assert_allclose(getattr(got, name), getattr(sent, name), rtol=0, atol=9 * 2.0**-24)


def symmetric(cov: np.ndarray) -> np.ndarray:
    """The upper triangles, mirrored: rounding differs between both halves of a product."""
    return np.triu(cov) + np.triu(cov, 1).mT


@pytest.mark.parametrize("column", RelativePositions.COLUMNS)
def test_columns_of_other_lengths_are_refused(column: str):
    longer = msgspec.structs.replace(GOOD, **{column: getattr(GOOD, column) + b"\0"})
    with pytest.raises(MessageError):
        decode(encode(longer), RelativePositions)


def changed(name: str, row: int, value: float) -> dict[str, bytes]:
    dtype, width = RelativePositions.COLUMNS[name]
    column = np.frombuffer(getattr(GOOD, name), dtype).copy()
    column[row * width] = value
    return {name: column.tobytes()}


@pytest.mark.parametrize(
    "change",
    [
        changed("position", 0, math.nan),
        changed("position", 1, 1e5),
        changed("cov", 0, -1.0),
        changed("cov", 1, math.inf),
        changed("cov", 1, math.nan),
        changed("normals", 0, 3.0),
        changed("probability", 0, 1.1),
        changed("probability", 1, math.nan),
        changed("normal_sigma", 1, -0.1),
        changed("axis_distance", 0, -1.0),
        {"camera": "a/b"},
        {"diameter_m": 0.0},
        {"t_ns": -1},
        {"exposure_us": math.nan},
        {"clock_error_us": -1.0},
        {"version": 2},
    ],
    ids=lambda change: next(iter(change)),
)
def test_impossible_content_is_refused(change: dict):
    with pytest.raises(MessageError):
        decode(encode(msgspec.structs.replace(GOOD, **change)), RelativePositions)


def test_an_unknown_distance_is_possible():
    decode(encode(msgspec.structs.replace(GOOD, **changed("axis_distance", 0, math.nan))), RelativePositions)


def test_a_message_with_too_many_positions_is_refused():
    many = pack_random(MAX_POSITIONS + 1)
    with pytest.raises(MessageError, match="257 roundels"):
        decode(encode(many), RelativePositions)


@given(st.data())
def test_altered_messages_are_valid_or_refused(data: st.DataObject):
    whole = bytearray(encode(GOOD))
    places = st.tuples(st.integers(0, len(whole) - 1), st.integers(0, 255))
    for place, value in data.draw(st.lists(places, max_size=8)):
        whole[place] = value
    try:
        got = decode(bytes(whole), RelativePositions).unpack()
    except MessageError:
        return
    assert np.isfinite(got.position).all()
    assert (np.linalg.eigvalsh(got.cov) > 0).all()
