# SPDX-License-Identifier: BSD-3-Clause
"""Programs of Roundel with the certificate of their role."""

import contextlib
import time
from collections.abc import Iterator

import msgspec
import numpy as np
import pytest

from calib.live.rig_requests import set_rig, step_rig
from calib.rig.rig import Rig
from camera_node.foundation.errors import NetworkError
from camera_node.node.rig_lens import RigLens
from camera_node.protocol.messages import Detections, Roundels, encode
from camera_node.protocol.requests import RequestError
from fusion.client.arena import Arena
from fusion.protocol.pose_messages import RobotsRequest
from fusion.protocol.robot_requests import change_robots, request_robots
from tests.security.lab import ARENA, KEYS, Lab, certificates
from tests.waiting import DEADLINE_S, wait_for
from tests.web.arena import four_cameras


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    folder = tmp_path_factory.mktemp("lab")
    certificates(folder, "localhost", "camera.north", "viewer", "operator").check_returncode()
    with contextlib.ExitStack() as closing:
        yield Lab(folder, closing)


def frame(camera: str) -> bytes:
    roundels = Roundels.from_points(np.array([[1.0, 2.0]]), 0.3)
    return encode(Detections.pack(roundels, camera=camera, seq=1, t_ns=time.time_ns(), width=640, height=480))


def test_the_server_receives_a_camera_s_frames_and_a_viewer_its_status(lab: Lab):
    camera = lab.session("camera.north")
    with Arena.connect(lab.endpoint, zenoh_config=lab.config("viewer")) as arena:
        statuses = arena.status(timeout_s=DEADLINE_S)
        camera.put(KEYS.detections("north"), frame("north"))
        wait_for(
            lambda: "north" in statuses.next().cameras,
            lambda: camera.put(KEYS.detections("north"), frame("north")),
        )


def test_a_viewer_reads_robots_and_an_operator_changes_them(lab: Lab):
    viewer, operator = lab.session("viewer"), lab.session("operator")
    request = RobotsRequest(remove=("robot_b",))
    assert "robot_b" in request_robots(viewer, ARENA).robots
    with pytest.raises(NetworkError):
        change_robots(viewer, ARENA, request, timeout_s=1.0)
    assert "robot_b" in request_robots(viewer, ARENA).robots, (
        "the server did not receive the viewer's request"
    )
    assert "robot_b" not in change_robots(operator, ARENA, request).robots


def test_only_an_operator_changes_the_rig(lab: Lab):
    """A camera and a viewer find no server that takes a rig; only the server publishes one."""
    rig = four_cameras()
    for role in ("camera.north", "viewer"):
        with pytest.raises(NetworkError, match="no server answers"):
            set_rig(lab.session(role), ARENA, rig, "test", timeout_s=0.5)
    operator = lab.session("operator")
    assert set_rig(operator, ARENA, rig, "test").rig == rig
    with pytest.raises(RequestError, match="no earlier version"):
        step_rig(operator, ARENA, "undo", "test")


def test_a_camera_receives_its_lens(lab: Lab):
    """It asks for the rig in force, and receives each change."""
    operator = lab.session("operator")
    own, other = list(four_cameras().cameras.values())[:2]
    set_rig(operator, ARENA, Rig(cameras={"north": own}), "test")
    followed = RigLens(lab.session("camera.north"), KEYS, "north")
    wait_for(lambda: followed.lens is not None)
    assert followed.lens is not None
    assert followed.lens.fx == own.fx
    changed = msgspec.structs.replace(other, fx=own.fx + 10)
    set_rig(operator, ARENA, Rig(cameras={"north": changed}), "test")
    wait_for(lambda: followed.lens is not None and followed.lens.fx == changed.fx)
    followed.close()
