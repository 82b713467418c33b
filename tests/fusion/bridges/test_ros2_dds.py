# SPDX-License-Identifier: BSD-3-Clause
"""An arena's robots in ROS 2 over DDS. The oracle is a DDS participant in a process of its own, with its own types."""

import os
import re
from dataclasses import dataclass

import pytest
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, float64, int8, int32, sequence, uint32
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from fusion.bridges.ros2_dds import ON_LOOPBACK
from tests.conftest import ROOT
from tests.fusion.bridges.ros2_arena import POSE, ROS, bridging, draw_pose, publishing, routing
from tests.processes import run_program
from tests.waiting import wait_for

DOMAIN = os.getpid() % 100 + 100  # of this worker


@dataclass
class Time(IdlStruct, typename="builtin_interfaces.msg.dds_.Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs.msg.dds_.Header_"):
    stamp: Time
    frame_id: str


@dataclass
class Point(IdlStruct, typename="geometry_msgs.msg.dds_.Point_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs.msg.dds_.Vector3_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs.msg.dds_.Quaternion_"):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Pose(IdlStruct, typename="geometry_msgs.msg.dds_.Pose_"):
    position: Point
    orientation: Quaternion


@dataclass
class PoseWithCovariance(IdlStruct, typename="geometry_msgs.msg.dds_.PoseWithCovariance_"):
    pose: Pose
    covariance: array[float64, 36]


@dataclass
class Twist(IdlStruct, typename="geometry_msgs.msg.dds_.Twist_"):
    linear: Vector3
    angular: Vector3


@dataclass
class TwistWithCovariance(IdlStruct, typename="geometry_msgs.msg.dds_.TwistWithCovariance_"):
    twist: Twist
    covariance: array[float64, 36]


@dataclass
class Odometry(IdlStruct, typename="nav_msgs.msg.dds_.Odometry_"):
    header: Header
    child_frame_id: str
    pose: PoseWithCovariance
    twist: TwistWithCovariance


@dataclass
class NamedPose(IdlStruct, typename="motion_capture_tracking_interfaces.msg.dds_.NamedPose_"):
    name: str
    pose: Pose


@dataclass
class NamedPoseArray(IdlStruct, typename="motion_capture_tracking_interfaces.msg.dds_.NamedPoseArray_"):
    header: Header
    poses: sequence[NamedPose]


@dataclass
class Marker(IdlStruct, typename="mocap4r2_msgs.msg.dds_.Marker_"):
    id_type: int8
    marker_index: int32
    marker_name: str
    translation: Point


@dataclass
class RigidBody(IdlStruct, typename="mocap4r2_msgs.msg.dds_.RigidBody_"):
    rigid_body_name: str
    markers: sequence[Marker]
    pose: Pose


@dataclass
class RigidBodies(IdlStruct, typename="mocap4r2_msgs.msg.dds_.RigidBodies_"):
    header: Header
    frame_number: uint32
    rigidbodies: sequence[RigidBody]


def test_a_participant_of_dds_receives_the_robots_and_lists_the_topics(monkeypatch):
    """Readers as `ros2 topic echo` and Crazyswarm2 make them, which asks for poses every 10 ms."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    words = ["--dds", "--domain", f"{DOMAIN}", "--namespace", "lab", "--sets", "crazyswarm2", "mocap4r2"]
    domain, node = Domain(DOMAIN, ON_LOOPBACK), DomainParticipant(DOMAIN)
    reliable = Qos(Policy.Reliability.Reliable(duration(milliseconds=100)), Policy.History.KeepLast(10))
    sensor = Qos(Policy.Reliability.BestEffort, Policy.Deadline(duration(milliseconds=10)))
    wanted = {
        "rt/lab/rover/odometry": (Odometry, reliable),
        "rt/lab/poses": (NamedPoseArray, sensor),
        "rt/lab/rigid_bodies": (RigidBodies, reliable),
    }
    readers = {name: DataReader(node, Topic(node, name, kind), qos) for name, (kind, qos) in wanted.items()}
    writers = BuiltinDataReader(node, BuiltinTopicDcpsPublication)
    received, topics = {}, {}

    def has_all() -> bool:
        for name, reader in readers.items():
            received.update((name, sample) for sample in reader.take(1))
        topics.update({writer.topic_name: writer for writer in writers.take(100)})
        return received.keys() == wanted.keys() and "rt/tf" in topics

    poses = [POSE, draw_pose("drone-2", seed=4), draw_pose("gone", "lost")]
    with routing() as (server, endpoint), publishing(server, poses), bridging(endpoint, *words):
        wait_for(has_all)
    odometry, named, bodies = (received[name] for name in wanted)
    assert odometry.child_frame_id == "rover"
    assert {header.frame_id for header in (odometry.header, named.header, bodies.header)} == {"world"}
    assert [entry.name for entry in named.poses] == ["rover", "drone-2"]
    assert [body.rigid_body_name for body in bodies.rigidbodies] == ["rover", "drone-2"]
    for pose in (odometry.pose.pose, named.poses[0].pose, bodies.rigidbodies[0].pose):
        assert (pose.position.x, pose.position.y, pose.position.z) == POSE.position
        q = pose.orientation
        assert (q.w, q.x, q.y, q.z) == POSE.quaternion_wxyz
    kinds = {"rt/lab/rover/odometry": "nav_msgs/msg/Odometry", "rt/tf": "tf2_msgs/msg/TFMessage"}
    for topic, kind in kinds.items():
        assert topics[topic].type_name == kind.replace("/msg/", "::msg::dds_::") + "_"
        assert topics[topic].qos[Policy.Userdata].data == f"typehash={ROS.hash_rihs01(kind)};".encode()
    del domain


def test_the_launch_file_gives_options_that_exist():
    """ROS's own launch is not on this machine: its words are those of the command."""
    text = (ROOT / "configs" / "ros2" / "roundel.launch.py").read_text()
    compile(text, "roundel.launch.py", "exec")
    page = run_program("fusion", "ros2", "--help").stdout
    defaults = re.search(r"DEFAULTS = \{(.*?)\n\}", text, re.DOTALL)
    assert defaults is not None
    for option in ["dds", "no-dds", *re.findall(r'^    "(\w+)":', defaults[1], re.MULTILINE)]:
        assert f"--{option}" in page


@pytest.mark.parametrize("option", ["--humble", "--ros tcp/localhost:7447"])
def test_options_of_zenoh_are_refused_with_dds(option):
    program = run_program("fusion", "ros2", "--dds", *option.split())
    assert program.returncode == 2
    assert "leave out --dds" in program.stderr
