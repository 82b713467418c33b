# SPDX-License-Identifier: BSD-3-Clause
"""The ROS 2 messages that the bridge sends, with their definitions, the hashes of those, and their types in DDS."""

import json
import re
from functools import cache
from hashlib import sha256
from typing import Any

from camera_node.foundation.extras import require

POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE_STAMPED = "geometry_msgs/msg/PoseWithCovarianceStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
NAMED_POSES = "motion_capture_tracking_interfaces/msg/NamedPoseArray"  # of Crazyswarm2
RIGID_BODIES = "mocap4r2_msgs/msg/RigidBodies"  # of mocap4r2, version 0.0.4

# The fields of each message, without constants, as in the .msg files of its package.
DEFINITIONS = {
    "builtin_interfaces/msg/Time": "int32 sec, uint32 nanosec",
    "std_msgs/msg/Header": "builtin_interfaces/msg/Time stamp, string frame_id",
    "geometry_msgs/msg/Point": "float64 x, float64 y, float64 z",
    "geometry_msgs/msg/Vector3": "float64 x, float64 y, float64 z",
    "geometry_msgs/msg/Quaternion": "float64 x, float64 y, float64 z, float64 w",
    "geometry_msgs/msg/Pose": "geometry_msgs/msg/Point position, geometry_msgs/msg/Quaternion orientation",
    "geometry_msgs/msg/Twist": "geometry_msgs/msg/Vector3 linear, geometry_msgs/msg/Vector3 angular",
    "geometry_msgs/msg/Transform": "geometry_msgs/msg/Vector3 translation, geometry_msgs/msg/Quaternion rotation",
    "geometry_msgs/msg/TransformStamped": "std_msgs/msg/Header header, string child_frame_id, "
    "geometry_msgs/msg/Transform transform",
    "geometry_msgs/msg/PoseWithCovariance": "geometry_msgs/msg/Pose pose, float64[36] covariance",
    "geometry_msgs/msg/TwistWithCovariance": "geometry_msgs/msg/Twist twist, float64[36] covariance",
    "motion_capture_tracking_interfaces/msg/NamedPose": "string name, geometry_msgs/msg/Pose pose",
    "mocap4r2_msgs/msg/Marker": "int8 id_type, int32 marker_index, string marker_name, "
    "geometry_msgs/msg/Point translation",
    "mocap4r2_msgs/msg/RigidBody": "string rigid_body_name, mocap4r2_msgs/msg/Marker[] markers, "
    "geometry_msgs/msg/Pose pose",
    POSE_STAMPED: "std_msgs/msg/Header header, geometry_msgs/msg/Pose pose",
    POSE_WITH_COVARIANCE_STAMPED: "std_msgs/msg/Header header, geometry_msgs/msg/PoseWithCovariance pose",
    ODOMETRY: "std_msgs/msg/Header header, string child_frame_id, geometry_msgs/msg/PoseWithCovariance pose, "
    "geometry_msgs/msg/TwistWithCovariance twist",
    TRANSFORMS: "geometry_msgs/msg/TransformStamped[] transforms",
    NAMED_POSES: "std_msgs/msg/Header header, motion_capture_tracking_interfaces/msg/NamedPose[] poses",
    RIGID_BODIES: "std_msgs/msg/Header header, uint32 frame_number, "
    "mocap4r2_msgs/msg/RigidBody[] rigidbodies",
}
FIELD = re.compile(r"(?P<kind>[\w/]+)(?P<array>\[(?P<size>\d*)\])? (?P<name>\w+)")
NESTED, OF_ARRAY, OF_SEQUENCE = 1, 48, 144  # numbers of rosidl's type_description_interfaces/msg/FieldType
NUMBERS = {"int8": 2, "int32": 6, "uint32": 7, "float64": 11, "string": 17}


def dds_name(kind: str) -> str:
    """The name of a message in DDS and in rmw_zenoh, such as `geometry_msgs::msg::dds_::PoseStamped_`."""
    package, _, message = kind.split("/")
    return f"{package}::msg::dds_::{message}_"


@cache
def type_hash(kind: str) -> str:
    """The hash of a message's definition (REP 2016), which topics carry since ROS 2 Iron."""
    used: dict[str, dict[str, Any]] = {}
    described = _describe(kind, used)
    others = [used[name] for name in sorted(used) if name != kind]
    text = json.dumps({"type_description": described, "referenced_type_descriptions": others})
    return f"RIHS01_{sha256(text.encode()).hexdigest()}"


def _describe(kind: str, used: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """A type description of rosidl; adds it and those of its fields to `used`."""
    fields = []
    for field in FIELD.finditer(DEFINITIONS[kind]):
        of, size = field["kind"], field["size"]
        if of in DEFINITIONS:
            _describe(of, used)
        number = NUMBERS.get(of, NESTED) + (0 if not field["array"] else OF_ARRAY if size else OF_SEQUENCE)
        described = {
            "type_id": number,
            "capacity": int(size or 0),
            "string_capacity": 0,
            "nested_type_name": of if of in DEFINITIONS else "",
        }
        fields.append({"name": field["name"], "type": described})
    used[kind] = {"type_name": kind, "fields": fields}
    return used[kind]


@cache
def dds_type(kind: str) -> Any:
    """The class of a message for cyclonedds.

    Raises:
        ConfigError: cyclonedds is missing.
    """
    idl = require("cyclonedds.idl", "dds", "ROS 2 over DDS")
    types = require("cyclonedds.idl.types", "dds", "ROS 2 over DDS")
    fields = {}
    for field in FIELD.finditer(DEFINITIONS[kind]):
        of = field["kind"]
        item = dds_type(of) if of in DEFINITIONS else str if of == "string" else getattr(types, of)
        if field["array"]:
            item = types.array[item, int(field["size"])] if field["size"] else types.sequence[item]
        fields[field["name"]] = item
    name = dds_name(kind)
    return idl.make_idl_struct(name.rsplit("::", 1)[1], name.replace("::", "."), fields)
