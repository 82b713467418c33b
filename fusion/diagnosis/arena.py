# SPDX-License-Identifier: BSD-3-Clause
"""Checks a running arena: its server, its cameras and their clocks."""

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime

from calib.rig.rig import Rig
from camera_node.foundation.errors import NetworkError
from camera_node.protocol.messages import CameraStatus
from fusion.client.arena import Arena
from fusion.diagnosis.findings import Finding
from fusion.diagnosis.machine import check_rig
from fusion.protocol.arena_health import camera_problems
from fusion.protocol.pose_messages import FusionStatus

LISTEN_S = 2.5  # at least two statuses of every camera
MAX_CAMERAS = 256
MAX_CLOCK_ERROR_MS = 1.0  # a robot at 1 m/s moves 1 mm in this time
REMEDIES = {
    "sends no frames": "check its program: journalctl -u roundel-camera@NAME",
    "is not calibrated": "calibrate it: roundel calibrate wand --live --only NAME",
    "repeats an old image": "restart its node, or replug the camera",
    "was moved and is excluded": "drive a robot through its view, or calibrate it again",
    "two nodes use its name": "give each node a --name of its own",
}


@dataclass(frozen=True)
class Observation:
    """What a running arena reports in a few seconds."""

    status: FusionStatus
    cameras: Mapping[str, CameraStatus]
    rig: Rig | None


def observe(arena: Arena, timeout_s: float) -> Observation | None:
    """Receive the statuses of the server and the cameras; None where no server answers within `timeout_s`."""
    cameras: dict[str, CameraStatus] = {}

    def keep(status: CameraStatus) -> None:
        if len(cameras) < MAX_CAMERAS:
            cameras[status.camera] = status

    arena.camera_statuses().on_message(keep)
    end_s = time.monotonic() + LISTEN_S
    try:
        status = arena.status(timeout_s).next()
        while time.monotonic() < end_s:
            status = arena.status(timeout_s).next()
        return Observation(status, cameras, arena.rig(timeout_s))
    except NetworkError:
        return None


def check_arena(observation: Observation, now: datetime) -> Iterator[Finding]:
    """The cameras, their clocks, the robots and the rig in force."""
    status = observation.status
    yield from _check_cameras(status)
    for name, camera in sorted(observation.cameras.items()):
        yield _check_clock(name, camera)
    yield check_rig(observation.rig, now)
    for name, state in status.robots.items():
        remedy = "" if state == "tracked" else "check that cameras see it, and its markers: roundel define"
        yield Finding("warning" if remedy else "ok", f"robot {name}", state, remedy)
    for name, residual in status.geometry_residuals_px.items():
        yield Finding(
            "warning",
            f"robot {name}",
            f"its markers are {residual:.1f} px from their places",
            "measure it again",
        )
    for name, diameter_m in status.measured_diameters_m.items():
        yield Finding(
            "warning",
            f"robot {name}",
            f"its discs measure {1e3 * diameter_m:.1f} mm, other than declared",
            "correct diameter_m in robots.yaml, or the lengths in wand.yaml if all robots differ",
        )


def _check_cameras(status: FusionStatus) -> Iterator[Finding]:
    if not status.cameras:
        yield Finding("error", "cameras", "none sends frames", "start roundel camera on their machines")
    for name, health in sorted(status.cameras.items()):
        problems = camera_problems(health)
        for problem in problems:
            yield Finding("error", f"camera {name}", problem, REMEDIES[problem].replace("NAME", name))
        if not problems:
            residual = "" if health.residual_px is None else f", residual {health.residual_px:.2f} px"
            yield Finding("ok", f"camera {name}", f"{health.fps:.0f} frames/s{residual}")


def _check_clock(name: str, camera: CameraStatus) -> Finding:
    subject = f"clock of {name}"
    if camera.clock_offset_ms is None or camera.clock_error_ms is None:
        return Finding(
            "error", subject, "no answer from the server's clock", "check the network of that machine"
        )
    state = f"offset {camera.clock_offset_ms:.2f} ms, known within {camera.clock_error_ms:.2f} ms"
    if camera.clock_error_ms > MAX_CLOCK_ERROR_MS:
        return Finding("warning", subject, state, "the network is slow or busy: use a cable")
    return Finding("ok", subject, state)
