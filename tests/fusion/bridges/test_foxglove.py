# SPDX-License-Identifier: BSD-3-Clause
"""A live server in Foxglove's websocket, read by the schemas that it sends."""

import contextlib
import re
import socket
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from camera_node.geometry.pose import rotation_from_wxyz
from camera_node.protocol.messages import Preview, encode
from camera_node.protocol.session import open_client
from camera_node.protocol.tcp_sockets import tcp_sockets
from fusion.bridges.foxglove_server import serving
from fusion.client.arena import Arena
from fusion.protocol.pose_messages import RobotPose
from tests.fusion.arena_process import ARENA, cameras_at, saving
from tests.fusion.bridges.foxglove_reader import FoxgloveClient
from tests.fusion.bridges.pose_server import bridge
from tests.fusion.serving import KEYS, ServerProcess
from tests.fusion.synthetic import TRIANGLE
from tests.missing_package import advice_without
from tests.processes import first_line
from tests.waiting import DEADLINE_S, Inbox, repeating


def place(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]


def wxyz(q: Any) -> list[float]:
    return [q.w, q.x, q.y, q.z]


def nanoseconds(stamp: Any) -> int:
    return stamp.seconds * 10**9 + stamp.nanos


@pytest.mark.ci
def test_foxglove_shows_the_arena_and_continues_after_a_restart(tmp_path: Path):
    with (
        ServerProcess(saving(tmp_path)) as server,
        cameras_at(server.endpoint),
        Arena.connect(server.endpoint, arena="test") as arena,
        bridge("foxglove", "--connect", server.endpoint, "--port", "0") as process,
    ):
        inbox = Inbox()
        arena.robot("a").on_pose(inbox.put)
        match = re.search(r":(\d+)$", first_line(process))
        assert match
        with FoxgloveClient(int(match[1])) as client:
            check_poses(client, inbox)
            check_cameras(client)
            check_scene(client)
            _, _, update = client.next("/markers")
            (unlabeled,) = update.entities
            assert unlabeled.frame_id == "world"
            assert len(unlabeled.spheres) <= 4  # those of the robot that the server does not know
        check_images(int(match[1]), server.endpoint)
        since_ns = inbox.items[-1].t_ns
        server.kill()
        server.start()
        with FoxgloveClient(int(match[1])) as client:
            while client.next("/tf")[1] <= since_ns:
                pass


def check_poses(client: FoxgloveClient, inbox: Inbox) -> None:
    _, log_ns, content = client.next("/tf")
    *_, transform = content.transforms  # the newest one; a bridge that was busy sends several at once
    assert nanoseconds(transform.timestamp) == log_ns
    assert (transform.parent_frame_id, transform.child_frame_id) == ("world", "a")
    assert inbox.until(lambda poses: any(p.t_ns == log_ns for p in poses))
    (pose,) = [p for p in inbox.items if p.t_ns == log_ns]
    assert isinstance(pose, RobotPose)
    assert place(transform.translation) == list(pose.position)
    assert wxyz(transform.rotation) == list(pose.quaternion_wxyz)
    topic, log_ns, stamped = client.next("/robots/")
    assert (topic, stamped.frame_id) == ("/robots/a/pose", "world")
    assert inbox.until(lambda poses: any(p.t_ns == log_ns for p in poses))
    (pose,) = [p for p in inbox.items if p.t_ns == log_ns]
    assert place(stamped.pose.position) == list(pose.position)


def check_cameras(client: FoxgloveClient) -> None:
    names, end = set(), time.monotonic() + DEADLINE_S
    while len(names) < len(ARENA.cameras):
        assert time.monotonic() < end, "no transforms of the cameras"
        topic, _, content = client.next("/cameras/")
        if topic == "/cameras/tf":
            names |= {transform.child_frame_id for transform in content.transforms}
            for transform in content.transforms:
                T = ARENA.cameras[transform.child_frame_id.removeprefix("camera/")].matrix()
                assert place(transform.translation) == pytest.approx(T[:3, 3], abs=1e-6)
                assert rotation_from_wxyz(wxyz(transform.rotation)) == pytest.approx(T[:3, :3], abs=1e-6)
    topic, _, content = client.next("/cameras/")
    while not topic.endswith("/calibration"):
        topic, _, content = client.next("/cameras/")
    camera = ARENA.cameras[topic.split("/")[2]]
    assert (content.width, content.height, content.frame_id) == (
        camera.width,
        camera.height,
        f"camera/{topic.split('/')[2]}",
    )
    assert np.array(content.K).reshape(3, 3) == pytest.approx(
        np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    )
    assert list(content.D) == pytest.approx(camera.distortion)


def check_scene(client: FoxgloveClient) -> None:
    while not (update := client.next("/scene")[2]).entities:
        pass  # a busy machine loses the robot, which is then removed for a while
    (body,) = update.entities
    assert (body.id, body.frame_id, body.frame_locked) == ("a", "a", True)
    points = [place(disc.pose.position) for disc in body.cylinders]
    assert np.array(points) == pytest.approx(TRIANGLE.points)


def check_images(port: int, endpoint: str) -> None:
    """Previews are asked for only while a client looks at them."""
    camera = sorted(ARENA.cameras)[0]
    picture = cv2.imencode(".jpg", np.full((48, 64), 90, np.uint8))[1].tobytes()
    preview = encode(Preview(camera=camera, t_ns=123, width=640, height=480, jpeg=picture))
    with open_client([endpoint]) as session:
        publisher = session.declare_publisher(KEYS.preview(camera))
        assert not publisher.matching_status.matching  # pyright: ignore[reportAttributeAccessIssue]
        with repeating(lambda: publisher.put(preview), 0.05), FoxgloveClient(port, images=True) as client:
            topic, t_ns, image = client.next(f"/cameras/{camera}/image")
    assert (topic, t_ns, image.format, image.data) == (f"/cameras/{camera}/image", 123, "jpeg", picture)


def test_without_the_sdk_one_line_says_what_to_install():
    advice = advice_without("foxglove", "fusion", "foxglove")
    assert "pip install 'roundel[foxglove]'" in advice


def test_messages_do_not_wait_for_acknowledgements():
    """Nagle's algorithm is off on the server's end of a connection: it added up to 40 ms to every other frame set."""
    with serving("127.0.0.1", 0, "test") as (_, port), FoxgloveClient(port):
        ends = []
        for end in tcp_sockets():
            with contextlib.suppress(OSError):  # a listener has no peer
                if end.getsockname()[1:2] == (port,) and end.getpeername():
                    ends.append(end.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))
        assert ends
        assert all(ends)
