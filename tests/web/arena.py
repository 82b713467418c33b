# SPDX-License-Identifier: BSD-3-Clause
"""An arena without programs: a test sends the messages of its cameras and its server."""

import time

import numpy as np
import zenoh

from calib.rig.camera import Camera
from calib.rig.rig import Rig
from calib.rig.rig_messages import RigMessage
from camera_node.detection.roundels import Roundels
from camera_node.geometry.pose import Pose, look_at
from camera_node.protocol.messages import CameraStatus, Detections, Keys, encode
from camera_node.protocol.session import listening_endpoints, open_router
from fusion.protocol.pose_messages import (
    CameraHealth,
    Contradiction,
    FusionStatus,
    Latency,
    Markers,
    RobotPose,
    TrackingState,
)


class ArenaMessages:
    """Messages of the cameras and the server of arena "test"; `put` sends them."""

    keys = Keys("test")
    rig_t_ns = time.time_ns()

    def put(self, key: str, data: bytes) -> None:
        raise NotImplementedError

    def pose(
        self,
        robot: str,
        position: tuple[float, float, float],
        state: TrackingState = "tracked",
        key: str = "",
    ) -> None:
        message = RobotPose(
            robot=robot,
            t_ns=time.time_ns(),
            state=state,
            position=position,
            quaternion_wxyz=(1.0, 0.0, 0.0, 0.0),
            velocity=(0.5, 0.0, 0.0),
            angular_velocity=(0.0, 0.0, 0.0),
            covariance=(1e-6 * np.eye(12)).astype("<f4").tobytes(),
            n_markers=3,
            latency=Latency(camera_ms=3.0, network_ms=0.2, wait_ms=4.0, fuse_ms=0.5, total_ms=7.7),
        )
        self.put(self.keys.robot_pose(key or robot), encode(message))

    def markers(
        self,
        positions: list[tuple[float, float, float]],
        normals: list[tuple[float, float, float]] | None = None,
    ) -> None:
        n = len(positions)
        unknown = [(np.nan, np.nan, np.nan)] * n
        message = Markers(
            t_ns=time.time_ns(),
            robots=("rover",),
            camera_names=("north",),
            position=np.array(positions, "<f8").tobytes(),
            covariance=np.zeros((n, 9), "<f4").tobytes(),
            normal=np.array(normals or unknown, "<f4").tobytes(),
            robot=np.array([0] * min(n, 1) + [-1] * (n - 1), "<i4").tobytes(),
            marker=np.array([0] * min(n, 1) + [-1] * (n - 1), "<i4").tobytes(),
            cameras=np.ones(n, "<u8").tobytes(),
        )
        self.put(self.keys.markers, encode(message))

    def camera(self, name: str, advice: str = "") -> None:
        message = CameraStatus(
            camera=name,
            t_ns=time.time_ns(),
            width=640,
            height=480,
            fps=29.97,
            frames=100,
            dropped=2,
            detect_ms=0.71,
            roundels=8.0,
            saturated=0.0,
            clock_offset_ms=0.02,
            edge_blur_px=0.62,
            advice=advice,
        )
        self.put(self.keys.camera_status(name), encode(message))

    def detections(self, name: str, uv: list[tuple[float, float]]) -> None:
        roundels = Roundels.from_points(np.array(uv), 0.1)
        message = Detections.pack(roundels, camera=name, seq=0, t_ns=time.time_ns(), width=640, height=480)
        self.put(self.keys.detections(name), encode(message))

    def status(
        self, cameras: tuple[str, ...] = ("north",), contradictions: tuple[Contradiction, ...] = ()
    ) -> None:
        health = CameraHealth(
            fps=29.97, lateness_ms=5.1, residual_px=0.08, assigned=200, unassigned=3, late=1, calibrated=True
        )
        message = FusionStatus(
            t_ns=time.time_ns(),
            frame_sets_per_s=30.0,
            latency_ms=7.7,
            cpu=0.12,
            memory_mb=140.0,
            cameras=dict.fromkeys(cameras, health),
            robots={"rover": "tracked"},
            faults={"camera unknown": 4},
            contradictions=contradictions,
            rig_t_ns=self.rig_t_ns,
        )
        self.put(self.keys.fusion_status, encode(message))

    def rig(self, rig: Rig) -> None:
        self.put(self.keys.rig, encode(RigMessage(t_ns=self.rig_t_ns, rig=rig)))


class LiveArena(ArenaMessages):
    """Sends the messages over Zenoh, as its router."""

    def __init__(self) -> None:
        listen = ["tcp/127.0.0.1:0"]
        self.session = open_router(listen)
        (self.endpoint,) = listening_endpoints(self.session, listen)

    def put(self, key: str, data: bytes) -> None:
        self.session.put(key, data)

    def serve_rig(self, rig: Rig) -> zenoh.Queryable:
        """Answer queries for the rig, as the server does."""

        def answer(query: zenoh.Query) -> None:
            query.reply(self.keys.rig, encode(RigMessage(t_ns=self.rig_t_ns, rig=rig)))

        return self.session.declare_queryable(self.keys.rig, answer)


def four_cameras() -> Rig:
    """Four cameras on the sides of a square of 4 m, 3 m high, that look at its centre."""
    lens = {"width": 640, "height": 480, "fx": 560.0, "fy": 560.0, "cx": 319.5, "cy": 239.5}
    corners = {"north": (0.1, 2, 3), "east": (2, 0.1, 3), "south": (0.1, -2, 3), "west": (-2, 0.1, 3)}
    poses = {name: Pose.from_matrix(look_at(corner, (0, 0, 0.2))) for name, corner in corners.items()}
    return Rig(cameras={name: Camera(**lens, T_world_cam=pose) for name, pose in poses.items()})
