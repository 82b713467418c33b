# SPDX-License-Identifier: BSD-3-Clause
"""A rig message is read back as it was sent; implausible and malformed ones are refused in one line."""

from datetime import date
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.errors import CalibrationError
from calib.rig.messages import RigMessage, RigRequest
from calib.rig.rig import Rig, dump_rig, load_rig, save_rig
from camera_node.foundation.errors import ConfigError
from camera_node.protocol.messages import MessageError, decode, encode
from camera_node.protocol.requests import RequestError, RequestSource, parse_request
from tests.calib.rig.hostile import as_publication, hostile_messages
from tests.calib.synthetic import ring

RIG = ring(2).truth
HOSTILE = hostile_messages(RIG)


def test_a_message_is_read_back():
    rig = Rig(
        cameras=RIG.cameras, calibration={"date": "2026-11-22", "residual_px": float("inf"), "a": [1, {}]}
    )
    message = RigMessage(t_ns=5, rig=rig, saved=True, source=RequestSource.of("calib undo"))
    assert decode(encode(message), RigMessage) == message
    assert message.source is not None
    assert str(message.source).startswith("calib undo of ")


@pytest.mark.parametrize("fault", HOSTILE)
def test_a_hostile_message_is_refused_in_one_line(fault: str):
    with pytest.raises(RequestError) as refusal:
        parse_request(HOSTILE[fault], RigRequest)
    assert len(str(refusal.value).splitlines()) == 1
    assert len(str(refusal.value)) < 300
    with pytest.raises(MessageError):
        decode(as_publication(HOSTILE[fault]), RigMessage)


@pytest.mark.parametrize(
    "text", ['{"version": 1e999}', '{"version": 99999999999999999999}', '{"rig": ' * 5000]
)
def test_hostile_json_is_refused(text: str):
    with pytest.raises(RequestError):
        parse_request(text.encode(), RigRequest)


@pytest.mark.parametrize("offset", [".nan", ".inf", "1.0e+308", "-20000.0"])
def test_an_implausible_offset_in_a_file_is_refused(tmp_path, offset: str):
    text = dump_rig(RIG).replace("  cam0:", f"  cam0:\n    time_offset_ms: {offset}")
    (tmp_path / "rig.yaml").write_text(text)
    with pytest.raises(ConfigError, match="camera 'cam0': time_offset_ms"):
        load_rig(tmp_path / "rig.yaml")


def test_an_implausible_rig_is_not_written(tmp_path):
    """Older versions of msgspec do not check in `structs.replace`."""
    rig = Rig(cameras={})
    camera = msgspec.structs.replace(RIG.cameras["cam0"], time_offset_ms=float("nan"))
    msgspec.structs.force_setattr(rig, "cameras", {"cam0": camera})
    with pytest.raises(CalibrationError, match=r"rig\.yaml is not written: camera 'cam0'"):
        save_rig(rig, tmp_path / "rig.yaml")
    assert not list(tmp_path.iterdir())


VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63) + 1, 2**63 - 1)
    | st.floats(allow_nan=False)
    | st.just(float("nan"))
    | st.text(max_size=30),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("rig") / "rig.yaml"


@settings(max_examples=40)
@given(figures=st.dictionaries(st.text(max_size=10), VALUES, max_size=4))
def test_any_figures_that_a_message_holds_are_saved_and_loaded(path: Path, figures: dict[str, Any]):
    """Compared as YAML, because NaN does not equal itself."""
    rig = Rig(cameras=RIG.cameras, calibration=figures)
    path.write_text(dump_rig(rig))
    received = decode(encode(RigMessage(t_ns=0, rig=rig)), RigMessage).rig
    assert dump_rig(load_rig(path)) == dump_rig(received) == dump_rig(rig)


def test_a_date_that_yaml_reads_as_one_is_no_fault(tmp_path):
    text = dump_rig(RIG).replace("calibration: {}", "calibration: {date: 2026-11-22}")
    (tmp_path / "rig.yaml").write_text(text)
    rig = load_rig(tmp_path / "rig.yaml")
    assert rig.calibration["date"] == date(2026, 11, 22)
    assert decode(encode(RigMessage(t_ns=0, rig=rig)), RigMessage).rig.cameras == rig.cameras
