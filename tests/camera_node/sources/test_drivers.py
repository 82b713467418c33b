# SPDX-License-Identifier: BSD-3-Clause
"""Identities of sources: the same after a restart and on another port, and different for different cameras."""

from pathlib import Path

import pytest

from camera_node.node.server_registration import camera_id
from camera_node.sources.drivers import identify
from camera_node.sources.v4l2_cameras import device_key


def plug_in(sys: Path, number: int, port: str, serial: str) -> Path:
    """Create the kernel's files of a USB camera, as /sys/class/video4linux has them."""
    interface = sys.parent / "devices" / f"usb-{port}" / f"{port}:1.0"
    interface.mkdir(parents=True)
    (interface / "bInterfaceNumber").write_text("00\n")
    for name, text in (("idVendor", "046d"), ("idProduct", "0825"), ("serial", serial)):
        if text:
            (interface.parent / name).write_text(f"{text}\n")
    entry = sys / f"video{number}"
    entry.mkdir(parents=True)
    (entry / "name").write_text("webcam\n")
    (entry / "index").write_text("0\n")
    (entry / "device").symlink_to(interface)
    return Path(f"/dev/video{number}")


def test_a_serial_number_identifies_a_camera_on_every_port(tmp_path: Path):
    """The number of the device and the port change with the order in which cameras are plugged in."""
    first = plug_in(tmp_path / "a" / "sys", 0, "1-2", "8F3A")
    second = plug_in(tmp_path / "b" / "sys", 4, "1-7", "8F3A")
    assert device_key(first, tmp_path / "a" / "sys") == device_key(second, tmp_path / "b" / "sys")


@pytest.mark.parametrize("serial", ["", "SN0001"])
def test_cameras_without_a_serial_number_of_their_own_are_identified_by_the_port(tmp_path: Path, serial: str):
    """Cheap cameras of one model have none, or all the same."""
    devices = [plug_in(tmp_path / "sys", number, f"1-{number}", serial) for number in range(2)]
    keys = [device_key(device, tmp_path / "sys") for device in devices]
    assert keys[0] != keys[1]
    assert all("1-" in key for key in keys)


def test_folders_and_simulated_cameras_propose_their_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A folder is the same by a relative and an absolute path."""
    (tmp_path / "north").mkdir()
    monkeypatch.chdir(tmp_path)
    relative, absolute = identify("north"), identify(str(tmp_path / "north"))
    assert (relative.key, relative.name) == (absolute.key, "north")
    assert identify("sim:east").name == "east"


def test_ids_are_names():
    """They are parts of Zenoh keys, and equal for equal keys only."""
    assert camera_id("usb a") == camera_id("usb a") != camera_id("usb b")
    assert len(camera_id("usb a")) == 16
