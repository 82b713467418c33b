# SPDX-License-Identifier: BSD-3-Clause
"""An arena whose poses the bridges of ROS 2 publish, and ROS's types by `rosbags`."""

import contextlib
import subprocess
import sys
import time
from collections.abc import Iterator

import msgspec
import numpy as np
import zenoh
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from camera_node.protocol.messages import ClockReply, Keys, encode
from camera_node.protocol.session import listening_endpoints, open_router
from fusion.model.limits import Limits
from fusion.protocol.pose_messages import RobotPose
from tests.fusion.bridges.pose_server import publish_poses, status
from tests.processes import killed_at_end
from tests.waiting import DEADLINE_S, repeating

ROS = get_typestore(Stores.ROS2_JAZZY)
OTHER_PACKAGES = {  # as their repositories have them
    "motion_capture_tracking_interfaces/msg/NamedPose": "string name\ngeometry_msgs/Pose pose\n",
    "motion_capture_tracking_interfaces/msg/NamedPoseArray": "std_msgs/Header header\nNamedPose[] poses\n",
    "mocap4r2_msgs/msg/Marker": "int8 USE_NAME=0\nint8 USE_INDEX=1\nint8 USE_BOTH=2\n\nint8 id_type\n"
    "int32 marker_index\nstring marker_name\ngeometry_msgs/Point translation\n",
    "mocap4r2_msgs/msg/RigidBody": "string rigid_body_name\nMarker[] markers\ngeometry_msgs/Pose pose\n",
    "mocap4r2_msgs/msg/RigidBodies": "std_msgs/Header header\nuint32 frame_number\n"
    "mocap4r2_msgs/RigidBody[] rigidbodies\n",
}
for kind, definition in OTHER_PACKAGES.items():
    ROS.register(get_types_from_msg(definition, kind))


def draw_pose(robot: str = "rover", state: str = "tracked", seed: int = 7) -> RobotPose:
    rng = np.random.default_rng(seed)
    A, q = rng.normal(size=(12, 12)), rng.normal(size=4)
    return RobotPose(
        robot=robot,
        t_ns=1_790_000_000_123_456_789,
        state=state,  # pyright: ignore[reportArgumentType]: one of the three
        position=tuple(rng.normal(size=3).tolist()),
        quaternion_wxyz=tuple((q / np.linalg.norm(q)).tolist()),
        velocity=tuple(rng.normal(size=3).tolist()),
        angular_velocity=tuple(rng.normal(size=3).tolist()),
        covariance=(A @ A.T).astype("<f4").tobytes(),
        n_markers=3,
    )


POSE = draw_pose()


@contextlib.contextmanager
def routing() -> Iterator[tuple[zenoh.Session, str]]:
    """A router and its endpoint, with a port that the operating system chooses."""
    listen = ["tcp/127.0.0.1:0"]
    with open_router(listen) as router:
        yield router, listening_endpoints(router, listen)[0]


def bridging(endpoint: str, *options: str) -> contextlib.AbstractContextManager[subprocess.Popen]:
    command = [sys.executable, "-m", "fusion", "ros2", "--connect", endpoint, "--arena", "test", *options]
    return killed_at_end(command, stderr=subprocess.PIPE, text=True)


@contextlib.contextmanager
def publishing(session: zenoh.Session, poses: list[RobotPose]) -> Iterator[None]:
    """Publish the poses repeatedly, of the present time, and answer with that time, as a server does."""
    keys, patient = Keys("test"), Limits(lateness_ms=1e3 * DEADLINE_S)

    def publish() -> None:
        t_ns = time.time_ns()
        session.put(keys.fusion_status, encode(status(t_ns, patient)))
        publish_poses(session, [msgspec.structs.replace(pose, t_ns=t_ns) for pose in poses])

    def answer(query: zenoh.Query) -> None:
        query.reply(query.key_expr, encode(ClockReply(t_ns=time.time_ns())))

    clock = session.declare_queryable(keys.clock, answer)
    with repeating(publish, 0.05):
        yield
    clock.undeclare()
