# SPDX-License-Identifier: BSD-3-Clause
"""Makes tests/data/arena_VERSION: the folder of an arena as a server of this version leaves it, and a recording.

Run as `python -m tests.data.make_arena` in the repository's root when a version is released; `tests/test_upgrade.py`
reads the folder with every later version.
"""

import shutil
from importlib.metadata import version
from pathlib import Path

import msgspec

from calib.rig.recording import RecordingWriter
from calib.rig.rig import Rig, save_rig
from calib.rig.rig_messages import RigMessage
from camera_node.protocol.camera_requests import change_camera
from camera_node.protocol.messages import Settings, encode
from camera_node.protocol.registration import CameraChange, CameraRegistration, register_key
from camera_node.protocol.requests import send_request
from fusion.model.robots import save_robots
from fusion.protocol.pose_messages import Robots, robots_key
from fusion.server.arena_config import load_arena
from tests.fusion.serving import ARENA, KEYS, serving
from tests.fusion.synthetic import TRIANGLE
from tests.waiting import DEADLINE_S

FOLDER = Path(__file__).resolve().parent / f"arena_{version('roundel')}"
ARENA_YAML = """\
arena: test
listen: [tcp/127.0.0.1:0]
rig: rig.yaml
robots: robots.yaml
saved_rig: rig.saved.yaml
saved_robots: robots.saved.yaml
cameras: cameras
"""
FRAMES = 20


def main() -> None:
    """Have a server save a second calibration, an undone third, two robots, and a camera with name and settings."""
    shutil.rmtree(FOLDER, ignore_errors=True)
    (FOLDER / "cameras").mkdir(parents=True)
    (FOLDER / "arena.yaml").write_text(ARENA_YAML)
    first = Rig(cameras=ARENA.cameras)
    save_rig(first, FOLDER / "rig.yaml")
    save_robots({"a": TRIANGLE}, FOLDER / "robots.yaml")
    with serving(load_arena(FOLDER / "arena.yaml")) as (_, client):
        camera = CameraRegistration(id="serial-1", name="camera-1", driver="v4l2")
        send_request(client.session, register_key("test"), encode(camera), DEADLINE_S)
        settings = Settings(exposure_us=4000.0)
        change_camera(client.session, "test", CameraChange(camera="serial-1", name="door", settings=settings))
        for lens_mm in (1.0, 2.0):
            client.set_rig(without_last(first, lens_mm))
        client.undo_rig()
        client.change_robots(
            define={"b": msgspec.structs.replace(TRIANGLE, diameter_m=0.07)}, rename={"a": "rover"}
        )
    (FOLDER / ".server.lock").unlink()
    with RecordingWriter(FOLDER / "recording.mcap") as writer:
        messages = sorted(ARENA.messages(FRAMES), key=lambda message: message.t_ns)
        start_ns = messages[0].t_ns
        writer.put(KEYS.rig, encode(RigMessage(t_ns=start_ns, rig=first)), start_ns)
        writer.put(robots_key("test"), encode(Robots(robots={"a": TRIANGLE})), start_ns)
        for message in messages:
            writer.put(KEYS.detections(message.camera), encode(message), message.t_ns + 20_000_000)


def without_last(rig: Rig, offset_ms: float) -> Rig:
    """The rig with one camera fewer, whose clocks differ."""
    cameras = dict(list(rig.cameras.items())[:-1])
    return Rig(cameras={n: msgspec.structs.replace(c, time_offset_ms=offset_ms) for n, c in cameras.items()})


if __name__ == "__main__":
    main()
