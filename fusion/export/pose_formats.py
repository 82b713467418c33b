# SPDX-License-Identifier: BSD-3-Clause
"""Writes poses and points in the formats of other programs. Files appear complete or not at all."""

import contextlib
import os
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np

from calib.rig.camera import Camera
from camera_node.foundation.config import hidden_folder, new_path, write_atomically, write_table
from camera_node.foundation.errors import ConfigError
from camera_node.foundation.extras import require
from camera_node.geometry.pose import wxyz_from_rotation
from fusion.bridges.foxglove_channels import FoxgloveChannels
from fusion.bridges.ros2_messages import odometries, pose_stamped, transforms
from fusion.bridges.ros2_node import ros_name
from fusion.bridges.ros2_types import ODOMETRY, POSE_STAMPED, TRANSFORMS
from fusion.export.points import PointTrajectories
from fusion.export.recorded_poses import MM, RecordedPoses
from fusion.protocol.pose_messages import RobotPose

Format = Literal["c3d", "trc", "csv", "tum", "parquet", "rerun", "rosbag", "foxglove", "observations"]
FORMATS: dict[str, Format] = {  # of `roundel export`, by suffix
    ".c3d": "c3d",
    ".trc": "trc",
    ".csv": "csv",
    ".tum": "tum",
    ".parquet": "parquet",
    ".rrd": "rerun",
    "": "rosbag",
    ".mcap": "foxglove",
}
MAX_FRAMES = 65535  # of a C3D file, whose counter has 16 bits
TRAIL_M = 0.004  # radius of a drawn trail
ROW_GROUP = 1 << 12  # rows of a Parquet file, each of 2 kB in memory and again as columns
COLUMNS = "t_ns,robot,x,y,z,qw,qx,qy,qz,vx,vy,vz,wx,wy,wz,state,n_markers,n_cameras"


def require_own_format(path: Path, *own: str) -> None:
    """Raise ConfigError for a result whose suffix is of another format of `roundel export` than those in `own`."""
    if path.suffix and FORMATS.get(path.suffix.lower(), "csv") not in {FORMATS[suffix] for suffix in own}:
        converted = f"; write {path.stem}.mcap, which roundel export converts" if ".mcap" in own else ""
        raise ConfigError(f"--out {path} does not end in {' or '.join(own)}{converted}")


def write_csv(poses: Iterable[RobotPose], path: Path) -> None:
    """Write all poses, with those of lost robots, with `COLUMNS`.

    Raises:
        ConfigError: the folder can't be written to.
    """
    write_table(path, COLUMNS, map(_row, poses))


def _row(pose: RobotPose) -> list:
    numbers = (*pose.position, *pose.quaternion_wxyz, *pose.velocity, *pose.angular_velocity)
    digits = [f"{number:.7g}" for number in numbers]
    return [pose.t_ns, pose.robot, *digits, pose.state, pose.n_markers, len(pose.cameras)]


def write_parquet(poses: Iterable[RobotPose], path: Path) -> None:
    """Write a table with one row for each pose, also of lost robots, in row groups of `ROW_GROUP`.

    It has `COLUMNS`, and `timestamp` (s since the first pose) and `frame_index` (the pose's number of its robot) as
    LeRobot's datasets name them; `cameras` that saw the robot, `residual_px`, `latency_ms`, and `covariance` (12 x 12,
    row by row, in the order of `RobotPose`).

    Raises:
        ConfigError: pyarrow is missing, or the file can't be written.
    """
    arrow, parquet = (require(name, "parquet", "Parquet") for name in ("pyarrow", "pyarrow.parquet"))
    schema = _schema(arrow)
    rows: list[tuple] = []
    start_ns: int | None = None
    counts: Counter[str] = Counter()
    with new_path(path) as part, parquet.ParquetWriter(part, schema, compression="zstd") as writer:

        def write_group() -> None:
            columns = [list(column) for column in zip(*rows, strict=True)]
            writer.write_batch(arrow.record_batch(columns, schema=schema))
            rows.clear()

        for pose in poses:
            start_ns = pose.t_ns if start_ns is None else start_ns
            rows.append(_parquet_row(pose, (pose.t_ns - start_ns) / 1e9, counts[pose.robot]))
            counts[pose.robot] += 1
            if len(rows) == ROW_GROUP:
                write_group()
        if rows:
            write_group()


def _schema(arrow: Any) -> Any:
    name = arrow.dictionary(arrow.int32(), arrow.string())
    types = {"t_ns": arrow.int64(), "timestamp": arrow.float64(), "frame_index": arrow.int64(), "robot": name}
    types |= dict.fromkeys(COLUMNS.split(",")[2:15], arrow.float64())
    types |= {"state": name, "n_markers": arrow.int32(), "n_cameras": arrow.int32()}
    types |= {"cameras": arrow.list_(arrow.string()), "residual_px": arrow.float32()}
    types |= {"latency_ms": arrow.float32(), "covariance": arrow.list_(arrow.float32(), 144)}
    return arrow.schema(
        list(types.items()), metadata={"frame": "world, metres, z up", "t_ns": "UTC, of the exposure"}
    )


def _parquet_row(pose: RobotPose, seconds: float, index: int) -> tuple:
    numbers = (*pose.position, *pose.quaternion_wxyz, *pose.velocity, *pose.angular_velocity)
    used = (pose.state, pose.n_markers, len(pose.cameras), pose.cameras, pose.residual_px)
    latency_ms = None if pose.latency is None else pose.latency.total_ms
    return (
        pose.t_ns,
        seconds,
        index,
        pose.robot,
        *numbers,
        *used,
        latency_ms,
        pose.covariance_matrix.ravel(),
    )


def write_tum(poses: RecordedPoses, path: Path, force: bool = False) -> list[Path]:
    """Write `timestamp tx ty tz qx qy qz qw`, as evo and the TUM benchmark read it, to one file for each robot.

    Returns:
        the files: `path`, or with several robots NAME-ROBOT and the suffix.

    Raises:
        ConfigError: one of them exists, and is not replaced by `force`.
    """
    with hidden_folder(path) as folder, contextlib.ExitStack() as opened:
        written: dict[str, IO[str]] = {}
        for pose in poses:
            if pose.state == "lost":
                continue
            if pose.robot not in written:
                written[pose.robot] = opened.enter_context((folder / f"{len(written)}").open("w"))
            w, x, y, z = pose.quaternion_wxyz
            seconds, ns = divmod(pose.t_ns, 1_000_000_000)
            numbers = " ".join(f"{value:.9g}" for value in (*pose.position, x, y, z, w))
            written[pose.robot].write(f"{seconds}.{ns:09} {numbers}\n")
        opened.close()
        several = len(written) > 1
        files = [path.with_stem(f"{path.stem}-{robot}") if several else path for robot in written]
        if existing := [file for file in files if file.exists() and not force]:
            raise ConfigError(f"{existing[0]} exists; give another name, or --force to replace it")
        for k, file in enumerate(files):
            os.replace(folder / f"{k}", file)
    return files


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
        new_path(path, own=("metadata.yaml", f"{path.name}.mcap")) as part,
        rosbag2.Writer(part, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer,
    ):

        def put(topic: str, kind: str, t_ns: int, data: bytes) -> None:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=types)
            writer.write(connections[topic], t_ns, data)

        for pose in poses:
            if pose.state != "lost":
                name = ros_name(pose.robot)
                put(f"/{name}/pose", POSE_STAMPED, pose.t_ns, pose_stamped(pose, "world"))
                (odom,) = odometries([pose], "world", [name])
                put(f"/{name}/odometry", ODOMETRY, pose.t_ns, odom)
                put("/tf", TRANSFORMS, pose.t_ns, transforms([pose], "world", [name]))


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


def write_rerun(poses: RecordedPoses, path: Path) -> None:
    """Write a recording of Rerun: the robots with their markers, trails and uncertainty (two standard deviations), and
    the cameras, on the timeline `capture`.

    Raises:
        ConfigError: rerun-sdk is missing, or the file can't be written.
    """
    rr = require("rerun", "rerun", "Rerun")
    stream = rr.RecordingStream("roundel")
    bodies = cameras = None
    try:
        with new_path(path) as part:
            stream.save(part)
            stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
            for pose in poses:
                stream.set_time("capture", timestamp=np.datetime64(pose.t_ns, "ns"))
                if poses.cameras is not cameras:
                    cameras = poses.cameras
                    for name, camera in cameras.items():
                        _log_camera(rr, stream, f"world/cameras/{name}", camera)
                if poses.bodies is not bodies:
                    bodies = poses.bodies
                    for name, body in bodies.items():
                        markers = rr.Points3D(body.points, radii=body.diameter_m / 2)
                        stream.log(f"world/robots/{name}/markers", markers)
                _log_pose(rr, stream, pose)
            stream.disconnect()  # writes what is buffered
    finally:
        stream.disconnect()


def _log_camera(rr: Any, stream: Any, entity: str, camera: Camera) -> None:
    size = (camera.width, camera.height)
    stream.log(f"{entity}/image", rr.Pinhole(image_from_camera=camera.K, resolution=size))
    if camera.T_world_cam is not None:
        T = camera.matrix()
        stream.log(entity, rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))


def _log_pose(rr: Any, stream: Any, pose: RobotPose) -> None:
    entity = f"world/robots/{pose.robot}"
    stream.log(f"states/{pose.robot}", rr.TextLog(pose.state))
    if pose.state == "lost":
        stream.log(entity, rr.Clear(recursive=False))
        return
    w, x, y, z = pose.quaternion_wxyz
    stream.log(entity, rr.Transform3D(translation=pose.position, quaternion=(x, y, z, w)))
    stream.log(f"world/trails/{pose.robot}", rr.Points3D([pose.position], radii=TRAIL_M))
    variances, axes = np.linalg.eigh(pose.covariance_matrix[3:6, 3:6])
    if np.linalg.det(axes) < 0:
        axes[:, 0] = -axes[:, 0]
    qw, *qxyz = wxyz_from_rotation(axes)
    ellipsoid = rr.Ellipsoids3D(
        centers=[pose.position],
        half_sizes=[2 * np.sqrt(np.maximum(variances, 0.0))],
        quaternions=[(*qxyz, qw)],
    )
    stream.log(f"world/uncertainty/{pose.robot}", ellipsoid)
    stream.log(f"residual_px/{pose.robot}", rr.Scalars(pose.residual_px or 0.0))
