# SPDX-License-Identifier: BSD-3-Clause
"""An arena's robots in ROS 2. The oracle is `rosbags`, an independent implementation of ROS's messages."""

import contextlib
import queue
from typing import Any

import msgspec
import numpy as np
import pytest
import zenoh
from zenoh.ext import Int64, z_deserialize

from camera_node.foundation.errors import ConfigError
from camera_node.geometry.pose import rotation_from_vector, rotation_from_wxyz
from fusion.bridges.body_motion import covariances, rotations, twists
from fusion.bridges.ros2_messages import named_poses, odometries, pose_stamped, rigid_bodies, transforms
from fusion.bridges.ros2_node import Ros2Node, ros_name
from fusion.bridges.ros2_types import DEFINITIONS, NAMED_POSES, RIGID_BODIES, type_hash
from fusion.bridges.ros2_zenoh import ZenohNode
from fusion.client.arena import Arena
from fusion.commands.bridges.ros2 import ros2
from tests.conftest import free_port
from tests.fusion.bridges.pose_server import PoseServer, restart
from tests.fusion.bridges.ros2_arena import POSE, ROS, bridging, draw_pose, publishing, routing
from tests.processes import run_program
from tests.waiting import DEADLINE_S


def read(data: bytes, kind: str) -> Any:
    """The message as ROS decodes it; its fields are created at run time."""
    return ROS.deserialize_cdr(data, kind)


@pytest.mark.parametrize("kind", DEFINITIONS)
def test_type_hashes_are_those_of_ros(kind):
    assert ROS.hash_rihs01(kind) == type_hash(kind)


def test_the_hash_is_the_one_that_ros_prints():
    """`ros2 topic info --verbose` of Jazzy."""
    printed = "RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8"
    assert type_hash("geometry_msgs/msg/PoseStamped") == printed


@pytest.mark.parametrize("frame", ["", "map", "world", "arena1"])  # lengths with every remainder modulo four
@pytest.mark.parametrize(
    ("kind", "write"),
    [
        ("geometry_msgs/msg/PoseStamped", lambda frame: pose_stamped(POSE, frame)),
        ("nav_msgs/msg/Odometry", lambda frame: odometries([POSE], frame, ["rover"])[0]),
        ("tf2_msgs/msg/TFMessage", lambda frame: transforms([POSE, POSE], frame, ["rover", "drone1"])),
        (NAMED_POSES, lambda frame: named_poses([POSE, draw_pose("cf-231")], frame)),
        (RIGID_BODIES, lambda frame: rigid_bodies([POSE, draw_pose("cf-231")], frame, 7)),
    ],
)
def test_bytes_are_those_of_ros(kind, write, frame):
    data = write(frame)
    assert bytes(ROS.serialize_cdr(read(data, kind), kind)) == data


def test_messages_have_the_values_of_the_pose():
    stamped = read(pose_stamped(POSE, "world"), "geometry_msgs/msg/PoseStamped")
    odom = read(odometries([POSE], "world", ["rover"])[0], "nav_msgs/msg/Odometry")
    (tf,) = read(transforms([POSE], "world", ["rover"]), "tf2_msgs/msg/TFMessage").transforms
    for message in (stamped, odom, tf):
        stamp = message.header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == POSE.t_ns
        assert message.header.frame_id == "world"
    assert odom.child_frame_id == tf.child_frame_id == "rover"
    for place in (stamped.pose.position, odom.pose.pose.position, tf.transform.translation):
        assert (place.x, place.y, place.z) == POSE.position
    for q in (stamped.pose.orientation, odom.pose.pose.orientation, tf.transform.rotation):
        assert (q.w, q.x, q.y, q.z) == POSE.quaternion_wxyz
    R, twist = rotation_from_wxyz(POSE.quaternion_wxyz), odom.twist.twist
    v_world = R @ [twist.linear.x, twist.linear.y, twist.linear.z]
    assert v_world == pytest.approx(POSE.velocity, rel=1e-12)
    assert R @ [twist.angular.x, twist.angular.y, twist.angular.z] == pytest.approx(POSE.angular_velocity)
    C = ros_covariance()
    assert odom.pose.covariance.reshape(6, 6) == pytest.approx(C[:6, :6], rel=1e-12)
    assert odom.twist.covariance.reshape(6, 6) == pytest.approx(C[6:, 6:], rel=1e-12)


def ros_covariance() -> np.ndarray:
    R = rotations([POSE])
    return covariances([POSE], R, twists([POSE], R))[0]


def test_covariance_is_that_of_sampled_poses():
    """Small random errors in our order, converted to ROS's quantities, have the covariance of the ROS message."""
    scale, rng = 1e-4, np.random.default_rng(3)
    R, v, w = (
        rotation_from_wxyz(POSE.quaternion_wxyz),
        np.array(POSE.velocity),
        np.array(POSE.angular_velocity),
    )
    L = np.linalg.cholesky(POSE.covariance_matrix)
    drawn = []
    for error in rng.normal(size=(4000, 12)) @ L.T * scale:
        true = R @ rotation_from_vector(error[:3])
        turn = true @ R.T - np.eye(3)  # about the world's axes
        drawn.append(
            [
                *error[3:6],
                *(turn[2, 1], turn[0, 2], turn[1, 0]),
                *(true.T @ (v + error[9:]) - R.T @ v),
                *(true.T @ (w + error[6:9]) - R.T @ w),
            ]
        )
    expected = ros_covariance()
    sd = np.sqrt(np.diag(expected))
    ratio = np.cov(np.transpose(drawn)) / scale**2 / np.outer(sd, sd)
    # correlations of 4000 draws have a standard deviation of at most sqrt(2 / 4000) = 0.022; five of them
    assert np.abs(ratio - expected / np.outer(sd, sd)).max() < 0.11


def ros_peer(endpoint: str) -> zenoh.Session:
    """A session as in rmw_zenoh_cpp: a peer that connects only to the router."""
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("connect/endpoints", f'["{endpoint}"]')
    config.insert_json5("listen/endpoints", '["tcp/127.0.0.1:0"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


@pytest.mark.parametrize("humble", [False, pytest.param(True, marks=pytest.mark.ci)])
@pytest.mark.parametrize("own_router", [False, pytest.param(True, marks=pytest.mark.ci)])
def test_a_node_of_rmw_zenoh_receives_the_robots_and_lists_the_topics(humble, own_router):
    options = ["--humble"] * humble
    received, tokens = queue.Queue(), queue.Queue()
    poses = [POSE, draw_pose("gone", "lost")]
    with contextlib.ExitStack() as stack:
        server, endpoint = stack.enter_context(routing())
        ros_endpoint = endpoint
        if own_router:
            _, ros_endpoint = stack.enter_context(routing())
            options += ["--ros", ros_endpoint]
        ros = stack.enter_context(ros_peer(ros_endpoint))
        topics = ros.declare_subscriber("3/lab/**", received.put)
        graph = ros.liveliness().declare_subscriber("@ros2_lv/3/**", tokens.put, history=True)
        stack.enter_context(publishing(server, poses))
        with bridging(endpoint, "--domain", "3", "--namespace", "/lab", *options):
            samples = [received.get(timeout=DEADLINE_S) for _ in range(6)]
            entities = {str(tokens.get(timeout=DEADLINE_S).key_expr) for _ in range(4)}
        topics.undeclare()
        graph.undeclare()
    kinds = {"pose": "geometry_msgs/msg/PoseStamped", "odometry": "nav_msgs/msg/Odometry"}
    for sample in samples:
        domain, namespace, robot, topic, typed, type_hash = str(sample.key_expr).split("/")
        kind = kinds[topic]
        assert (domain, namespace, robot) == ("3", "lab", "rover")
        assert typed == kind.replace("/msg/", "::msg::dds_::") + "_"
        assert type_hash == ("TypeHashNotSupported" if humble else ROS.hash_rihs01(kind))
        assert read(sample.payload.to_bytes(), kind).header.frame_id == "world"
    numbers = [
        z_deserialize(tuple[Int64, Int64, bytes], s.attachment)[0]
        for s in samples
        if "Odom" in str(s.key_expr)
    ]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))  # numbered by topic
    parts = sorted(entity.split("/")[4:] for entity in entities)
    assert parts[0] == ["0", "NN", "%", "%lab", "roundel"]
    names = {"%lab%rover%pose", "%lab%rover%odometry", "%tf"}
    assert {p[5] for p in parts[1:]} == names
    assert {p[1] for p in parts[1:]} == {"MP"}
    assert {p[8] for p in parts[1:]} == {"::,10:,:,:,,"}


def test_topics_continue_after_a_restart_of_the_server():
    """The server's router is that of ROS, too, so that publishers and tokens are declared in it again."""
    received, tokens, endpoint = queue.Queue(), queue.Queue(), f"tcp/127.0.0.1:{free_port()}"

    def seconds(sample: zenoh.Sample) -> float:
        stamp = read(sample.payload.to_bytes(), "nav_msgs/msg/Odometry").header.stamp
        return stamp.sec + 1e-9 * stamp.nanosec

    with PoseServer(endpoint) as server, ros_peer(endpoint) as ros, bridging(endpoint):
        topics = ros.declare_subscriber("0/rover/odometry/**", received.put)
        received.get(timeout=DEADLINE_S)
        since_s = restart(server) * 1e-9
        while seconds(received.get(timeout=DEADLINE_S)) <= since_s:
            pass
        graph = ros.liveliness().declare_subscriber(
            "@ros2_lv/0/**/%rover%odometry/**", tokens.put, history=True
        )
        assert "/MP/" in str(tokens.get(timeout=DEADLINE_S).key_expr)
        graph.undeclare()
        topics.undeclare()


def test_robots_with_equal_ros_names_are_counted():
    assert [ros_name(n) for n in ("rover", "rover-2", "2nd", "öre")] == [
        "rover",
        "rover_2",
        "robot_2nd",
        "_re",
    ]
    with routing() as (session, _):
        node = Ros2Node(ZenohNode(session))
        node.publish([draw_pose(name) for name in ("rover-2", "rover_2", "rover_2")], "world")
        assert node.faults == {"poses of 'rover_2', which has the same ROS name as 'rover-2'": 2}


def test_the_last_message_of_each_burst_is_express():
    """Zenoh waits for more messages of a burst otherwise: 5 ms with 50 robots, `python -m tests.benchmarks.bridges`."""
    received, names = queue.Queue(), ["a", "b", "c"]
    with routing() as (session, _):
        subscriber = session.declare_subscriber("0/**", received.put)
        Ros2Node(ZenohNode(session)).publish([draw_pose(name) for name in names], "world")
        samples = [received.get(timeout=DEADLINE_S) for _ in range(2 * len(names) + 1)]
        subscriber.undeclare()
    topics = [f"{name}/{kind}" for kind in ("odometry", "pose") for name in names] + ["tf"]
    assert ["/".join(str(sample.key_expr).split("/")[1:-2]) for sample in samples] == topics
    assert [topic for topic, sample in zip(topics, samples, strict=True) if sample.express] == [
        "c/odometry",
        "c/pose",
        "tf",
    ]


@pytest.mark.parametrize("domain", ["-1", "233", "lab"])
def test_an_invalid_domain_is_refused(domain, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", domain)
    program = run_program("fusion", "ros2")
    assert program.returncode == 2
    assert f"the ROS domain is '{domain}'; give --domain" in program.stderr


@pytest.mark.parametrize("namespace", ["a-b", "1st", "a//b", "*"])
def test_an_invalid_namespace_is_refused(namespace):
    with pytest.raises(ConfigError, match="is no ROS namespace"):
        ros2(namespace=namespace)


def test_silence_is_logged_once_and_its_end_too():
    with routing() as (server, endpoint), bridging(endpoint) as process:
        assert process.stderr is not None
        assert "no pose from arena 'test'" in process.stderr.readline()
        with publishing(server, [POSE]):
            assert "receiving poses again" in process.stderr.readline()


def test_one_stream_has_the_poses_of_all_robots():
    poses, seen = [POSE, msgspec.structs.replace(POSE, robot="drone")], queue.Queue()
    with (
        routing() as (server, endpoint),
        Arena.connect(endpoint, arena="test") as arena,
        publishing(server, poses),
    ):
        arena.poses(DEADLINE_S).on_message(seen.put)
        assert {seen.get(timeout=DEADLINE_S).robot for _ in range(4)} == {"rover", "drone"}
        assert arena.robot("drone", DEADLINE_S).next().robot == "drone"
