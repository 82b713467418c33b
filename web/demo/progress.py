# SPDX-License-Identifier: BSD-3-Clause
"""Reports the demo's progress to the page and the terminal, and looks up the scene's true poses by wall-clock time."""

import time
from collections.abc import Iterable

import numpy as np
import zenoh

from calib.rig.camera import transform
from camera_node.foundation.arrays import Array
from camera_node.protocol.messages import encode
from camera_node.simulation.scene import Scene
from web.demo.score import PoseScore
from web.demo.usage import ResourceUsage
from web.state.feed import ArenaState
from web.state.messages import DemoProgress, progress_key

RECENT = 100  # poses whose median latency is shown


class SceneClock:
    """The simulated scene with its epoch: converts wall-clock time (ns) to scene time (s)."""

    def __init__(self, scene: Scene, epoch_ns: int) -> None:
        self.scene, self.epoch_ns = scene, epoch_ns

    def seconds(self, t_ns: int | None = None) -> float:
        """Return the scene time at `t_ns`, or now."""
        return ((time.time_ns() if t_ns is None else t_ns) - self.epoch_ns) * 1e-9

    def true_pose(self, robot: str, t_ns: int) -> Array | None:
        """Return T_world_robot (4, 4), or None while the robot is not in the scene."""
        return self.scene.robot_pose(robot, self.seconds(t_ns))

    def wand_points(self) -> dict[str, tuple]:
        """Return the wand's true marker positions by name, as in `DemoProgress`; empty without a wand."""
        T = self.scene.wand_pose(self.seconds())
        return {} if T is None else {"wand": tuple(map(tuple, transform(T, self.scene.wand.points).tolist()))}

    def wand_share(self) -> float:
        """Return the completed share of the wand session, 0 to 1."""
        return min(1.0, max(0.0, self.seconds() / self.scene.wave_s))


class ProgressReporter:
    """Publishes status lines for the page and prints them."""

    def __init__(self, session: zenoh.Session, arena: str, clock: SceneClock) -> None:
        self._session, self._key, self._clock = session, progress_key(arena), clock

    def report(self, text: str, share: float, print_text: bool) -> None:
        """Publish a status line and the completed share of the step, 0 to 1; also print the line if wanted."""
        points = self._clock.wand_points()
        progress = DemoProgress(t_ns=time.time_ns(), text=text, share=share, true_points=points)
        self._session.put(self._key, encode(progress))
        if print_text:
            print(text, flush=True)


def describe_calibration_step(clock: SceneClock, state: ArenaState) -> str:
    """Return the status line before, during and after the wand session."""
    t_s, wave_s = clock.seconds(), clock.scene.wave_s
    if t_s >= wave_s:
        return f"the wand session is over; calibrating ({t_s - wave_s:.0f} s)"
    if t_s < 0:
        return f"starting programs; the wand session begins in {-t_s:.0f} s"
    shares = ", ".join(f"{name} {100 * c.share:.0f} %" for name, c in sorted(state.coverage.items()))
    return f"waving the wand, {t_s:.0f} of {wave_s:.0f} s; image coverage: {shares or 'no camera yet'}"


def describe_errors(score: PoseScore) -> str:
    """Return the robots' position errors for the page, which has all other figures itself."""
    errors = ", ".join(f"{robot} {score.recent_mm(robot):.2f}" for robot in score.errors)
    return f"simulation: position errors in mm: {errors}"


def describe_tracking_step(score: PoseScore, usage: ResourceUsage, cameras: Iterable[str]) -> str:
    """Return the status line while the robots are tracked."""
    errors = ", ".join(f"{robot} {score.recent_mm(robot):.2f}" for robot in score.errors)
    rates = " ".join(f"{rate:.0f}" for rate in usage.frame_rates(cameras).values())
    latencies = score.latencies_ms[-RECENT:]
    p50 = f"{np.median(latencies):.1f} ms" if latencies else "unknown"
    return f"{usage.seconds():.0f} s: error mm {errors}; latency {p50}; frames/s {rates}"
