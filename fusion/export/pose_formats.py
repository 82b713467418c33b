# SPDX-License-Identifier: BSD-3-Clause
"""Writes poses and points in the formats of other programs. Files appear complete or not at all."""

import contextlib
import csv
import io
import os
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from camera_node.foundation.config import write_atomically
from camera_node.foundation.errors import ConfigError
from camera_node.foundation.extras import require
from fusion.bridges.foxglove_channels import FoxgloveChannels
from fusion.bridges.ros2_messages import odometries, pose_stamped, transforms
from fusion.bridges.ros2_node import ros_name
from fusion.export.points import PointTrajectories
from fusion.export.recorded_poses import RecordedPoses
from fusion.protocol.pose_messages import RobotPose

MAX_FRAMES = 65535  # of a C3D file, whose counter has 16 bits
MM = 1000.0
COLUMNS = "t_ns,robot,x,y,z,qw,qx,qy,qz,vx,vy,vz,wx,wy,wz,state,n_markers,n_cameras"


@contextlib.contextmanager
def new_path(path: Path) -> Iterator[Path]:
    """A hidden path beside `path` for a file or folder, which gets its name at the end; it is removed after an error.

    Raises:
        ConfigError: it can't be written, or the disk is full.
    """
    part = path.with_name(f".{path.name}.part{path.suffix}")
    try:
        _remove(part)
        yield part
        _remove(path)
        os.replace(part, path)
    except OSError as error:
        raise ConfigError(f"{path} can't be written: {error.strerror or error}; check its folder") from None
    finally:
        _remove(part)


def write_csv(poses: Iterable[RobotPose], path: Path) -> None:
    """Write all poses, with those of lost robots, with `COLUMNS`.

    Raises:
        ConfigError: the folder can't be written to.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS.split(","))
    writer.writerows(map(_row, poses))
    write_atomically(path, text.getvalue())


def _row(pose: RobotPose) -> list:
    numbers = (*pose.position, *pose.quaternion_wxyz, *pose.velocity, *pose.angular_velocity)
    digits = [f"{number:.7g}" for number in numbers]
    return [pose.t_ns, pose.robot, *digits, pose.state, pose.n_markers, len(pose.cameras)]


def write_tum(poses: RecordedPoses, path: Path) -> list[Path]:
    """Write `timestamp tx ty tz qx qy qz qw`, as evo and the TUM benchmark read it, to one file for each robot.

    Returns:
        the files: `path`, or with several robots NAME-ROBOT and the suffix.
    """
    lines: dict[str, list[str]] = {}
    for pose in poses:
        if pose.state != "lost":
            w, x, y, z = pose.quaternion_wxyz
            seconds, ns = divmod(pose.t_ns, 1_000_000_000)
            numbers = " ".join(f"{value:.9g}" for value in (*pose.position, x, y, z, w))
            lines.setdefault(pose.robot, []).append(f"{seconds}.{ns:09} {numbers}\n")
    several = len(lines) > 1
    files = {robot: path.with_stem(f"{path.stem}-{robot}") if several else path for robot in lines}
    for robot, file in files.items():
        write_atomically(file, "".join(lines[robot]))
    return list(files.values())


def write_c3d(table: PointTrajectories, path: Path) -> None:
    """Write points in millimetres; the parameter ROUNDEL:START_UTC_NS has the time of the first frame.

    Raises:
        ConfigError: ezc3d is missing, or a C3D file can't hold so many frames.
    """
    if len(table.points) > MAX_FRAMES:
        raise ConfigError(f"{len(table.points)} frames; C3D has {MAX_FRAMES} at most: give a lower --rate-hz")
    ezc3d = require("ezc3d", "export", "C3D")
    content = ezc3d.c3d()
    content["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    content["parameters"]["POINT"]["RATE"]["value"] = [table.rate_hz]
    content["parameters"]["POINT"]["LABELS"]["value"] = table.labels
    content.add_parameter("POINT", "X_SCREEN", ["+X"])
    content.add_parameter("POINT", "Y_SCREEN", ["+Z"])
    content.add_parameter("ROUNDEL", "START_UTC_NS", [str(table.start_ns)])
    homogeneous = np.ones((4, len(table.labels), len(table.points)))
    homogeneous[:3] = MM * table.points.transpose(2, 1, 0)
    content["data"]["points"] = homogeneous
    with new_path(path) as part:
        content.write(str(part))


def write_trc(table: PointTrajectories, path: Path) -> None:
    """Write points in millimetres as OpenSim reads them; a missing point has empty fields. The z axis points up."""
    n, rate = len(table.points), f"{table.rate_hz:.6f}"
    names = "\t".join(f"{label}\t\t" for label in table.labels)
    columns = "\t".join(f"X{k}\tY{k}\tZ{k}" for k in range(1, len(table.labels) + 1))
    head = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{n}\t{len(table.labels)}\tmm\t{rate}\t1\t{n}",
        f"Frame#\tTime\t{names}",
        f"\t\t{columns}",
        "",
    ]
    rows = (
        f"{k + 1}\t{k / table.rate_hz:.6f}\t"
        + "\t".join("" if np.isnan(value) else f"{value:.4f}" for value in MM * frame.ravel())
        for k, frame in enumerate(table.points)
    )
    write_atomically(path, "\n".join([*head, *rows, ""]))


def write_rosbag(poses: RecordedPoses, path: Path) -> None:
    """Write a ROS 2 bag (a folder) with the topics and messages of `fusion ros2`, in storage MCAP.

    Raises:
        ConfigError: rosbags is missing.
    """
    rosbag2 = require("rosbags.rosbag2", "export", "a ROS 2 bag")
    typesys = require("rosbags.typesys", "export", "a ROS 2 bag")
    types, connections = typesys.get_typestore(typesys.Stores.ROS2_JAZZY), {}
    with (
        new_path(path) as part,
        rosbag2.Writer(part, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer,
    ):

        def put(topic: str, kind: str, t_ns: int, data: bytes) -> None:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=types)
            writer.write(connections[topic], t_ns, data)

        for pose in poses:
            if pose.state != "lost":
                name = ros_name(pose.robot)
                put(f"/{name}/pose", "geometry_msgs/msg/PoseStamped", pose.t_ns, pose_stamped(pose, "world"))
                (odom,) = odometries([pose], "world", [name])
                put(f"/{name}/odometry", "nav_msgs/msg/Odometry", pose.t_ns, odom)
                put("/tf", "tf2_msgs/msg/TFMessage", pose.t_ns, transforms([pose], "world", [name]))


def write_foxglove(poses: RecordedPoses, path: Path) -> None:
    """Write an MCAP file with the topics of `roundel foxglove`, except images and unlabeled markers.

    Raises:
        ConfigError: foxglove-sdk is missing.
    """
    foxglove = require("foxglove", "foxglove", "Foxglove")
    context = foxglove.Context()
    bodies = cameras = None
    with new_path(path) as part, foxglove.open_mcap(str(part), context=context):
        channels = FoxgloveChannels(context)
        for pose in poses:
            if poses.cameras is not cameras:
                cameras = poses.cameras
                channels.add_cameras(cameras, pose.t_ns)
            if poses.bodies is not bodies:
                bodies = poses.bodies
                channels.add_bodies(bodies, pose.t_ns)
            channels.add_poses([pose])


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
