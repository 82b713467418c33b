# SPDX-License-Identifier: BSD-3-Clause
"""An arena in Foxglove's standard schemas, on channels of a context: a live server, or an MCAP file.

Frames: `world`, one of each robot's name, and `camera/NAME` in OpenCV's convention, which is also Foxglove's.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calib.rig.camera import Camera
from camera_node.foundation.extras import require
from camera_node.geometry.pose import rotation_with_z, wxyz_from_rotation
from camera_node.protocol.messages import Preview
from fusion.model.robots import Robot
from fusion.protocol.pose_messages import Markers, RobotPose, Vector

WORLD = "world"
THICKNESS_M = 0.002  # of a drawn roundel
UNLABELED_M = 0.03  # diameter of a drawn marker that belongs to no robot
LIFETIME_NS = 500_000_000  # of these
BLACK, ORANGE = (0.1, 0.1, 0.1, 1.0), (1.0, 0.6, 0.0, 1.0)
PINHOLE = {
    0: "plumb_bob",
    4: "plumb_bob",
    5: "plumb_bob",
    8: "rational_polynomial",
}  # by numbers of distortion


class FoxgloveChannels:
    """The channels: `/tf` and `/cameras/tf`, `/scene`, `/markers`, `/log`, and those of each robot and camera.

    Args:
        context: of `foxglove`.
    """

    def __init__(self, context: Any) -> None:
        self._context = context
        self._channels = require("foxglove.channels", "foxglove", "Foxglove")
        self._messages = require("foxglove.messages", "foxglove", "Foxglove")
        self._open: dict[str, Any] = {}
        self._states: dict[str, str] = {}
        self._bodies: Mapping[str, Robot] = {}
        for topic, schema in (("/log", "Log"), ("/scene", "SceneUpdate")):
            self._channel(
                topic, schema
            )  # a client subscribes to a channel that it knows: a first line must not be lost

    def add_poses(self, poses: Sequence[RobotPose]) -> None:
        """Log the transforms of robots that are not lost, `/robots/NAME/pose`, and changes of their states.

        A lost robot is removed from `/scene` until it is tracked again: its transform would stay where it was.
        """
        for pose in poses:
            before = self._states.get(pose.robot, pose.state)
            self._states[pose.robot] = pose.state
            if before != pose.state:
                self.add_log(f"{pose.robot} is {pose.state}", pose.t_ns, is_warning=pose.state == "lost")
            if "lost" in (before, pose.state) and before != pose.state:
                self._show(pose)
        shown = [pose for pose in poses if pose.state != "lost"]
        if not shown:
            return
        m = self._messages
        transforms = [
            self._transform(pose.t_ns, pose.robot, pose.position, pose.quaternion_wxyz) for pose in shown
        ]
        self._channel("/tf", "FrameTransforms").log(
            m.FrameTransforms(transforms=transforms), log_time=shown[-1].t_ns
        )
        for pose in shown:
            channel = self._channel(f"/robots/{pose.robot}/pose", "PoseInFrame")
            if channel.has_sinks():
                stamped = m.PoseInFrame(
                    timestamp=self._time(pose.t_ns),
                    frame_id=WORLD,
                    pose=self._pose(pose.position, pose.quaternion_wxyz),
                )
                channel.log(stamped, log_time=pose.t_ns)

    def add_cameras(self, cameras: Mapping[str, Camera], t_ns: int) -> None:
        """Log `/cameras/NAME/calibration`, and the transforms of the placed cameras.

        They have a topic of their own: after a jump, a player repeats the last message of each topic.
        """
        m, transforms = self._messages, []
        for name, camera in cameras.items():
            self._channel(f"/cameras/{name}/calibration", "CameraCalibration").log(
                self._calibration(name, camera, t_ns), log_time=t_ns
            )
            if camera.T_world_cam is not None:
                T = camera.matrix()
                place = (float(T[0, 3]), float(T[1, 3]), float(T[2, 3]))
                wxyz = tuple(wxyz_from_rotation(T[:3, :3]).tolist())
                transforms.append(self._transform(t_ns, _camera_frame(name), place, wxyz))
        self._channel("/cameras/tf", "FrameTransforms").log(
            m.FrameTransforms(transforms=transforms), log_time=t_ns
        )

    def add_bodies(self, bodies: Mapping[str, Robot], t_ns: int) -> None:
        """Log `/scene`: each robot's roundels and name, fixed to its frame; those that are gone or lost are removed."""
        m, self._bodies = self._messages, bodies
        entities = [
            self._body(name, body, t_ns) for name, body in bodies.items() if self._states.get(name) != "lost"
        ]
        wipe = m.SceneEntityDeletion(timestamp=self._time(t_ns), type=m.SceneEntityDeletionType.All)
        update = m.SceneUpdate(deletions=[wipe], entities=entities)
        self._channel("/scene", "SceneUpdate").log(update, log_time=t_ns)

    def _show(self, pose: RobotPose) -> None:
        """Log to `/scene` that a robot is there again, or is lost."""
        m, body = self._messages, self._bodies.get(pose.robot)
        if pose.state == "lost":
            kind = m.SceneEntityDeletionType.MatchingId
            gone = m.SceneEntityDeletion(timestamp=self._time(pose.t_ns), type=kind, id=pose.robot)
            update = m.SceneUpdate(deletions=[gone])
        elif body is not None:
            update = m.SceneUpdate(entities=[self._body(pose.robot, body, pose.t_ns)])
        else:
            return
        self._channel("/scene", "SceneUpdate").log(update, log_time=pose.t_ns)

    def add_markers(self, markers: Markers) -> None:
        """Log `/markers`: the unlabeled markers, which disappear after half a second."""
        channel = self._channel("/markers", "SceneUpdate")
        if not channel.has_sinks():
            return
        m = self._messages
        size = m.Vector3(x=UNLABELED_M, y=UNLABELED_M, z=UNLABELED_M)
        places = markers.positions()[markers.unlabeled()].tolist()
        spheres = [
            m.SpherePrimitive(pose=self._pose(p, (1, 0, 0, 0)), size=size, color=self._color(ORANGE))
            for p in places
        ]
        entity = m.SceneEntity(
            timestamp=self._time(markers.t_ns),
            frame_id=WORLD,
            id="unlabeled",
            lifetime=m.Duration(0, LIFETIME_NS),
            spheres=spheres,
        )
        channel.log(m.SceneUpdate(entities=[entity]), log_time=markers.t_ns)

    def add_image(self, preview: Preview) -> None:
        """Log `/cameras/NAME/image`, a JPEG."""
        image = self._messages.CompressedImage(
            timestamp=self._time(preview.t_ns),
            frame_id=_camera_frame(preview.camera),
            data=preview.jpeg,
            format="jpeg",
        )
        self._image(preview.camera).log(image, log_time=preview.t_ns)

    def wants_images(self, cameras: Sequence[str]) -> bool:
        """Whether somebody looks at the image of one of these cameras."""
        return any([self._image(name).has_sinks() for name in cameras])

    def add_log(self, text: str, t_ns: int, is_warning: bool = False) -> None:
        """Log a line to `/log`."""
        level = self._messages.LogLevel.Warning if is_warning else self._messages.LogLevel.Info
        entry = self._messages.Log(timestamp=self._time(t_ns), level=level, message=text, name="roundel")
        self._channel("/log", "Log").log(entry, log_time=t_ns)

    def _channel(self, topic: str, schema: str) -> Any:
        if topic not in self._open:
            kind = getattr(self._channels, f"{schema}Channel")
            self._open[topic] = kind(topic, context=self._context)
        return self._open[topic]

    def _image(self, camera: str) -> Any:
        return self._channel(f"/cameras/{camera}/image", "CompressedImage")

    def _time(self, t_ns: int) -> Any:
        return self._messages.Timestamp(*divmod(t_ns, 1_000_000_000))

    def _color(self, rgba: tuple[float, float, float, float]) -> Any:
        r, g, b, a = rgba
        return self._messages.Color(r=r, g=g, b=b, a=a)

    def _pose(self, position: Sequence[float], wxyz: Sequence[float]) -> Any:
        m = self._messages
        w, x, y, z = wxyz
        px, py, pz = position
        return m.Pose(position=m.Vector3(x=px, y=py, z=pz), orientation=m.Quaternion(x=x, y=y, z=z, w=w))

    def _transform(self, t_ns: int, child: str, position: Vector, wxyz: Sequence[float]) -> Any:
        m = self._messages
        w, x, y, z = wxyz
        px, py, pz = position
        return m.FrameTransform(
            timestamp=self._time(t_ns),
            parent_frame_id=WORLD,
            child_frame_id=child,
            translation=m.Vector3(x=px, y=py, z=pz),
            rotation=m.Quaternion(x=x, y=y, z=z, w=w),
        )

    def _calibration(self, name: str, camera: Camera, t_ns: int) -> Any:
        distortion = [float(value) for value in camera.distortion]
        model = "kannala_brandt" if camera.model == "fisheye" else PINHOLE.get(len(distortion), "")
        K = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
        return self._messages.CameraCalibration(
            timestamp=self._time(t_ns),
            frame_id=_camera_frame(name),
            width=camera.width,
            height=camera.height,
            distortion_model=model,
            D=distortion,
            K=K,
            R=np.eye(3).ravel().tolist(),
            P=[*K[0:3], 0.0, *K[3:6], 0.0, *K[6:9], 0.0],
        )

    def _body(self, name: str, body: Robot, t_ns: int) -> Any:
        m = self._messages
        size = m.Vector3(x=body.diameter_m, y=body.diameter_m, z=THICKNESS_M)
        discs = [
            m.CylinderPrimitive(
                pose=self._pose(point, tuple(wxyz.tolist())),
                size=size,
                bottom_scale=1.0,
                top_scale=1.0,
                color=self._color(BLACK),
            )
            for point, wxyz in zip(
                body.markers, wxyz_from_rotation(rotation_with_z(body.unit_normals)), strict=True
            )
        ]
        label = m.TextPrimitive(
            pose=self._pose((0.0, 0.0, body.diameter_m), (1, 0, 0, 0)),
            billboard=True,
            font_size=14.0,
            scale_invariant=True,
            color=self._color(BLACK),
            text=name,
        )
        return m.SceneEntity(
            timestamp=self._time(t_ns),
            frame_id=name,
            id=name,
            frame_locked=True,
            cylinders=discs,
            texts=[label],
        )


def _camera_frame(camera: str) -> str:
    return f"camera/{camera}"
