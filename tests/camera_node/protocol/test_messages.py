# SPDX-License-Identifier: BSD-3-Clause
"""Messages are decoded as they were encoded, and invalid bytes raise MessageError."""

import contextlib
import dataclasses
import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import calib.rig.rig_messages
import camera_node.protocol.messages
import fusion.protocol.pose_messages
from camera_node.detection.roundels import Roundels
from camera_node.protocol.messages import (
    MAX_ROUNDELS,
    CameraStatus,
    ClockReply,
    Detections,
    MessageError,
    Settings,
    decode,
    encode,
)
from fusion.protocol.pose_messages import FusionStatus, Markers, RobotPose
from tests.conftest import ROOT

KINDS = (Detections, CameraStatus, ClockReply, Settings, Markers, RobotPose, FusionStatus)
HEADER = {"camera": "cam0", "seq": 3, "t_ns": 1_700_000_000_000_000_000, "width": 640, "height": 480}


@st.composite
def roundels(draw: st.DrawFn) -> Roundels:
    """Columns like those of a detector: centres in range, positive definite covariances, other columns arbitrary."""
    n = draw(st.integers(0, 20))

    def column(*shape: int, low=-1e4, high=1e4):
        return draw(hnp.arrays(float, (n, *shape), elements=st.floats(low, high, width=32)))

    root = column(2, 2, low=-2.0, high=2.0)
    cov = root @ root.swapaxes(1, 2) + 0.01 * np.eye(2)
    number = draw(hnp.arrays(np.int32, n))
    return Roundels(
        column(2), cov, column(2), column(), column(), np.full(n, np.nan), number, np.full(n, -1, np.int32)
    )


@given(roundels())
def test_detections_are_decoded_as_they_were_encoded(sent: Roundels):
    """Centres to the bit; the other columns are float32, with rounding by half a unit in the last place."""
    got = decode(encode(Detections.pack(sent, **HEADER)), Detections).unpack()
    assert np.array_equal(got.uv, sent.uv)
    np.testing.assert_allclose(got.cov, sent.cov, rtol=2.0**-24, atol=2.0**-149)
    for name in ("axes_px", "angle_rad", "ratio", "contrast", "id", "track"):
        np.testing.assert_array_equal(getattr(got, name), getattr(sent, name))


@given(st.binary(max_size=400), st.sampled_from(KINDS))
def test_random_bytes_raise_no_other_error(data: bytes, kind: type[msgspec.Struct]):
    """Random bytes raise MessageError, or are a message of defaults."""
    with contextlib.suppress(MessageError):
        assert isinstance(decode(data, kind), kind)


@given(st.data())
def test_truncated_and_altered_messages_are_refused(data: st.DataObject):
    """A truncated message raises MessageError; one with replaced bytes is valid or raises MessageError."""
    whole = bytearray(encode(Detections.pack(Roundels.from_points(np.ones((3, 2)), 0.3), **HEADER)))
    cut = data.draw(st.integers(0, len(whole) - 1))
    with pytest.raises(MessageError):
        decode(bytes(whole[:cut]), Detections)
    for place, value in data.draw(
        st.lists(st.tuples(st.integers(0, len(whole) - 1), st.integers(0, 255)), max_size=8)
    ):
        whole[place] = value
    try:
        message = decode(bytes(whole), Detections)
        assert np.isfinite(message.unpack().uv).all()
    except MessageError:
        pass


def test_codes_are_sent_where_a_roundel_has_one():
    """Without a code, a message has no column of codes; a reader of either gets NaN where nothing is known."""
    plain = Roundels.from_points(np.ones((2, 2)), 0.3)
    coded = dataclasses.replace(
        plain,
        id=np.array([7, -1], np.int32),
        id_probability=np.array([1.0, np.nan]),
        rotation_rad=np.array([0.5, np.nan]),
        rotation_sigma=np.array([0.25, np.nan]),
    )
    for sent in (plain, coded):
        message = Detections.pack(sent, **HEADER)
        assert bool(message.rotation_rad) == (sent is coded)
        got = decode(encode(message), Detections).unpack()
        for name in ("id", "id_probability", "rotation_rad", "rotation_sigma"):
            np.testing.assert_array_equal(getattr(got, name), getattr(sent, name))
    older = {
        k: v for k, v in msgspec.msgpack.decode(encode(Detections.pack(plain, **HEADER))).items() if v != b""
    }
    assert np.isnan(decode(msgspec.msgpack.encode(older), Detections).unpack().rotation_rad).all()


COLUMNS = ("uv", "cov", "axes_px", "angle_rad", "ratio", "contrast", "id", "track")
GOOD = Detections.pack(Roundels.from_points(np.ones((2, 2)), 0.3), **HEADER)


@pytest.mark.parametrize("column", COLUMNS)
def test_columns_of_other_lengths_are_refused(column: str):
    with pytest.raises(MessageError, match=f"column {column} of"):
        decode(encode(msgspec.structs.replace(GOOD, **{column: getattr(GOOD, column) + b"\0"})), Detections)


@pytest.mark.parametrize(
    "change",
    [
        {"uv": np.array([math.nan, 1, 1, 1]).tobytes()},
        {"uv": np.array([1e300, 1, 1, 1]).tobytes()},
        {"cov": np.array([math.inf, 0, 0, 1, 0, 1], "<f4").tobytes()},
        {"cov": np.array([1, 1, 1, 1, 0, 1], "<f4").tobytes()},
        {"rotation_sigma": np.array([0.1, 0], "<f4").tobytes()},
        {"rotation_rad": np.array([math.inf, 0], "<f4").tobytes()},
        {"id_probability": np.array([1.5, 0.5], "<f4").tobytes()},
        {"width": 0},
        {"height": 10**6},
        {"t_ns": -1},
        {"exposure_us": math.nan},
        {"detect_us": math.inf},
        {"clock_error_us": -1.0},
        {"readout_us": math.nan},
        {"readout_us": -1.1e6},
        {"clock_error_us": math.inf},
        {"camera": ""},
        {"version": 2},
    ],
    ids=str,
)
def test_impossible_content_is_refused(change: dict):
    with pytest.raises(MessageError):
        decode(encode(msgspec.structs.replace(GOOD, **change)), Detections)


def test_a_message_with_too_many_roundels_is_refused():
    many = Detections.pack(Roundels.from_points(np.ones((MAX_ROUNDELS + 1, 2)), 0.3), **HEADER)
    with pytest.raises(MessageError, match=f"{MAX_ROUNDELS + 1} roundels"):
        decode(encode(many), Detections)


def test_a_newer_sender_may_add_fields():
    """Unknown fields are skipped, so that new fields do not need a new version."""
    fields = msgspec.msgpack.decode(encode(GOOD)) | {"colour": "red"}
    assert decode(msgspec.msgpack.encode(fields), Detections) == GOOD


def test_every_field_is_documented():
    """docs/messages.md has a section for every message of these modules, with a row for every field.

    The fields of a base class are in the sections of the messages that extend it.
    """
    sections = (ROOT / "docs" / "messages.md").read_text().split("\n## ")
    for module in (
        camera_node.protocol.messages,
        calib.rig.rig_messages,
        fusion.protocol.pose_messages,
    ):
        for name, kind in vars(module).items():
            if (
                isinstance(kind, type)
                and issubclass(kind, msgspec.Struct)
                and kind.__module__ == module.__name__
                and not kind.__subclasses__()
            ):
                section = next((s for s in sections if s.startswith(name + "\n")), None)
                assert section, f"{name} has no section"
                missing = [field for field in kind.__struct_fields__ if f"| `{field}` |" not in section]
                assert not missing, f"{name} lacks {missing}"


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("quaternion_wxyz", (0.0, 0.0, 0.0, 0.0)),
        ("position", (np.nan, 0.0, 0.0)),
        ("covariance", bytes(575)),
    ],
)
def test_an_invalid_pose_is_refused(field: str, value: object):
    good = {
        "robot": "a",
        "t_ns": 1,
        "state": "tracked",
        "position": (0.0, 0.0, 0.0),
        "quaternion_wxyz": (1.0, 0.0, 0.0, 0.0),
        "velocity": (0.0, 0.0, 0.0),
        "angular_velocity": (0.0, 0.0, 0.0),
        "covariance": bytes(576),
        "n_markers": 3,
        "cameras": (),
    }
    assert decode(msgspec.msgpack.encode(good), RobotPose).robot == "a"
    with pytest.raises(MessageError):
        decode(msgspec.msgpack.encode({**good, field: value}), RobotPose)
