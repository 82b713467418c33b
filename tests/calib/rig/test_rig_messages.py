# SPDX-License-Identifier: BSD-3-Clause
"""Messages about the rig, and the sentences about its changes."""

import os
from datetime import date
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.errors import CalibrationError
from calib.rig.camera import Camera
from calib.rig.rig import Rig, dump_rig, load_rig, save_rig
from calib.rig.rig_messages import RigChange, RigMessage, RigRequest, describe_change, holds_rig, read_change
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.pose import Pose
from camera_node.protocol.messages import MessageError, decode, encode
from camera_node.protocol.requests import RequestError, RequestSource, parse_request
from tests.calib.rig.hostile import as_publication, hostile_messages
from tests.calib.synthetic import ring
from tests.calib.world.landmarks import in_another_world
from tests.web.arena import four_cameras

RIG = ring(2).truth
HOSTILE = hostile_messages(RIG)
FOUR = four_cameras()
CHANGE = RigChange(t_ns=10**18, change="north 12.0 mm", source=RequestSource("web", "lab", "x"))


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


@pytest.mark.parametrize("offset", [".nan", ".inf", "1.0e+308", "-2.0e+8"])
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


def test_cameras_of_numpys_numbers_are_written_as_others(tmp_path):
    camera = RIG.cameras["cam0"]
    same = msgspec.structs.replace(
        camera, width=np.int64(camera.width), fx=np.float64(camera.fx), distortion=np.array(camera.distortion)
    )
    assert dump_rig(Rig(cameras={"cam0": same})) == dump_rig(Rig(cameras={"cam0": camera}))


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


def replaced(name: str, **fields: object) -> Rig:
    return Rig(cameras={**FOUR.cameras, name: msgspec.structs.replace(FOUR.cameras[name], **fields)})


def moved(camera: Camera, metres: float) -> Pose:
    T = camera.matrix()
    T[0, 3] += metres
    return Pose.from_matrix(T)


def test_changes_are_described():
    without_west = Rig(cameras={name: camera for name, camera in FOUR.cameras.items() if name != "west"})
    renamed = Rig(cameras={"door" if name == "west" else name: c for name, c in FOUR.cameras.items()})
    assert describe_change(None, FOUR) == "4 cameras placed"
    assert describe_change(FOUR, FOUR) == "the same poses"
    assert describe_change(FOUR, without_west) == "west not placed"
    assert describe_change(without_west, FOUR) == "west placed"
    assert describe_change(FOUR, renamed) == "west renamed door"
    assert describe_change(FOUR, in_another_world(FOUR)) == "floor and origin"
    assert describe_change(FOUR, replaced("north", fx=600.0)) == "lens of north"
    assert describe_change(FOUR, replaced("north", time_offset_ms=1.0)) == "clock offset of north"
    pose = moved(FOUR.cameras["north"], 0.012)
    assert describe_change(FOUR, replaced("north", T_world_cam=pose)) == "north 12.0 mm"


def test_many_changes_are_counted():
    cameras = {
        name: msgspec.structs.replace(camera, T_world_cam=moved(camera, 0.01 * (k + 1)), fx=600.0)
        for k, (name, camera) in enumerate(FOUR.cameras.items())
    }
    assert describe_change(FOUR, Rig(cameras=cameras)).endswith("20.0 mm, 1 more, lens of 4 cameras")


def test_a_saved_rig_says_what_changed(tmp_path: Path):
    """In a comment: programs that do not know it read the rig all the same."""
    path = tmp_path / "rig.yaml"
    save_rig(FOUR, path, CHANGE.line())
    assert (read_change(path), load_rig(path)) == (CHANGE, FOUR)
    assert holds_rig(path, FOUR)
    assert not holds_rig(path, replaced("north", fx=600.0))


@pytest.mark.parametrize(
    "line", ["", "# changed: by hand\n", '# changed: {"t_ns": -1}\n', '# changed: {"t_ns": 1, "change": 2}\n']
)
def test_a_file_without_a_change_has_the_time_of_its_modification(tmp_path: Path, line: str):
    path = tmp_path / "rig.yaml"
    save_rig(FOUR, path, line)
    os.utime(path, ns=(10**18, 10**18))
    assert read_change(path) == RigChange(t_ns=10**18)
