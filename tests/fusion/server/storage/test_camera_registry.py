# SPDX-License-Identifier: BSD-3-Clause
"""Names and settings of cameras: stable, unique, and the same in files and over the network."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from camera_node.protocol.messages import Settings
from camera_node.protocol.registration import CameraChange, CameraRegistration
from camera_node.protocol.requests import RequestError
from fusion.server.storage.camera_registry import MAX_CAMERAS, CameraRegistry

MASK = (((0.0, 0.0), (9.0, 0.0), (9.0, 9.0)),)
pytestmark = pytest.mark.computed


def request(id: str, name: str = "", **fields) -> CameraRegistration:
    return CameraRegistration(id=id, name=name, driver="v4l2", **fields)


@given(st.lists(st.tuples(st.sampled_from("abcdef"), st.sampled_from(["", "north", "camera-2"]))))
def test_a_camera_keeps_its_name_and_no_two_share_one(starts: list[tuple[str, str]]):
    """Whatever the order of starts and the names that cameras propose."""
    registry, names = CameraRegistry(None), dict[str, str]()
    for id, wish in starts:
        name = registry.register(request(id, wish))
        assert names.setdefault(id, name) == name
        assert len(set(names.values())) == len(names)


@given(st.lists(st.tuples(st.sampled_from("abc"), st.sampled_from(["x", "y", "camera-1"])), max_size=8))
def test_files_hold_what_the_server_knows(tmp_path_factory: pytest.TempPathFactory, renames):
    """After any renames, another server that reads the folder gives the same names and settings."""
    folder = tmp_path_factory.mktemp("cameras")
    registry = CameraRegistry(folder)
    for id in "abc":
        registry.register(request(id))
    for id, name in renames:
        settings = Settings(exposure_us=4000.0, mask=MASK)
        before = registry.cameras()
        try:
            registry.change(registry.find(id), CameraChange(camera=id, name=name, settings=settings))
        except RequestError:
            assert before[name].id != id
            assert registry.cameras() == before
    again = CameraRegistry(folder)
    assert again.cameras() == registry.cameras()
    assert {camera.id for camera in again.cameras().values()} == set("abc")


def test_an_editor_changes_the_same_files(tmp_path: Path):
    """A file that is renamed or edited while the server runs is the camera's new name and settings."""
    registry = CameraRegistry(tmp_path)
    assert registry.register(request("a")) == "camera-1"
    (tmp_path / "camera-1.yaml").rename(tmp_path / "north.yaml")
    with (tmp_path / "north.yaml").open("a") as file:
        file.write("settings: {gain: 3}\n")
    assert registry.register(request("a")) == "north"
    assert registry.cameras()["north"].settings == Settings(gain=3.0)


@pytest.mark.parametrize(
    "text", ["id: [", "id: a/b", "id: a", "name: x", "id: b\nsettings: {exposure_us: -1}"]
)
def test_a_broken_file_is_left_out(tmp_path: Path, text: str, caplog: pytest.LogCaptureFixture):
    """The others are used, and the log names the file. `id: a` is the id of another camera."""
    registry = CameraRegistry(tmp_path)
    registry.register(request("a"))
    (tmp_path / "other.yaml").write_text(text)
    known = registry.cameras()
    if "exposure" not in text:
        assert list(known) == ["camera-1"]
        assert "other.yaml" in caplog.text
    assert registry.register(request("a")) == "camera-1"


def test_changes_that_can_not_be_done_are_refused(tmp_path: Path):
    """With the reason; nothing is changed. A forgotten camera is a new one when it comes back."""
    registry = CameraRegistry(tmp_path)
    for id in "ab":
        registry.register(request(id))
    known = registry.cameras()
    with pytest.raises(RequestError, match="there are: camera-1, camera-2"):
        registry.find("camera-3")
    with pytest.raises(RequestError, match=r"another camera has the name camera-2.*roundel cameras forget"):
        registry.change("camera-1", CameraChange(camera="camera-1", name="camera-2"))
    assert registry.cameras() == known
    registry.change("camera-1", CameraChange(camera="camera-1", forget=True))
    assert list(registry.cameras()) == ["camera-2"]
    assert registry.register(request("a", "north")) == "north"


def test_the_number_of_cameras_is_bounded():
    """A sender of invented cameras can't fill the memory, and those that are known can still register."""
    registry = CameraRegistry(None)
    for k in range(MAX_CAMERAS):
        registry.register(request(f"id{k}"))
    with pytest.raises(RequestError, match=f"{MAX_CAMERAS} cameras"):
        registry.register(request("another"))
    assert registry.register(request("id0")) == "camera-1"


def test_registrations_alone_do_not_keep_a_camera_out(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    """A camera that only registered is forgotten for a new one; those that are used or have settings stay."""
    registry = CameraRegistry(tmp_path, {"camera-1"}.__contains__)
    for k in range(MAX_CAMERAS):
        registry.register(request(f"id{k}"))
    registry.change("camera-2", CameraChange(camera="camera-2", settings=Settings(gain=2.0)))
    names = [registry.register(request(f"new{k}")) for k in range(2 * MAX_CAMERAS)]
    assert not {"camera-1", "camera-2"} & set(names)
    assert len(registry.cameras()) == MAX_CAMERAS
    assert {"id0", "id1", f"new{2 * MAX_CAMERAS - 1}"} <= {
        camera.id for camera in registry.cameras().values()
    }
    assert "camera-3, which sends no frames, is forgotten" in caplog.text
    assert registry.cameras() == CameraRegistry(tmp_path).cameras()
