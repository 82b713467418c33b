# SPDX-License-Identifier: BSD-3-Clause
"""Runs the formation step by step, without a clock: the same robots, pictures, detector, messages and control.

A command takes effect one frame after the exposure on which it is based. That is longer than a node needs.
"""

from collections.abc import Iterator

from camera_node.detection.detector import Detector
from camera_node.detection.relative_positions import DiscLocalizer
from camera_node.protocol.messages import RelativePositions, decode, encode
from camera_node.simulation.floor import paint_floor
from formation.formation_control import Controller
from formation.formation_robots import CAMERA, FPS, ROUNDEL, RobotCamera, RobotWorld
from formation.live_formation import FormationScore, controllers, start_world


class RobotProgram:
    """What runs on one robot: its camera, detector, localizer and control."""

    def __init__(self, name: str, camera: RobotCamera, controller: Controller) -> None:
        self._name, self._camera, self._controller = name, camera, controller
        self._detector = Detector()
        self._localizer = DiscLocalizer(CAMERA, ROUNDEL.diameter_m)

    def see(self, world: RobotWorld, t_s: float, frame: int) -> None:
        """Take a picture at `t_s`, and give the control what was located in it, through the message."""
        located = self._localizer.locate(self._detector.detect(self._camera.capture(t_s, frame)))
        message = RelativePositions.pack(
            located,
            camera=self._name,
            seq=frame,
            t_ns=round(t_s * 1e9),
            diameter_m=ROUNDEL.diameter_m,
        )
        seen = decode(encode(message), RelativePositions).unpack()
        self._controller.see(seen, t_s, world.at(self._name, t_s).odometry)

    def drive(self, world: RobotWorld, t_s: float) -> None:
        """Give the robot the command for `t_s`."""
        world.drive(self._name, self._controller.command(t_s, world.at(self._name, t_s).odometry), t_s)


def run_lockstep(seconds: float, seed: int = 0) -> Iterator[tuple[float, FormationScore]]:
    """Yield time and score after each frame, for simulated `seconds`."""
    world, score, floor = start_world(seed), FormationScore(), paint_floor(seed)
    programs = [
        RobotProgram(name, RobotCamera(world, name, floor), controller)
        for name, controller in controllers().items()
    ]
    for frame in range(1, round(seconds * FPS)):
        t_s, next_s = frame / FPS, (frame + 1) / FPS
        world.advance(t_s)
        for program in programs:
            program.see(world, t_s, frame)
        score.add(t_s, {name: world.at(name, t_s).pose for name in world.names})
        world.advance(next_s)
        for program in programs:
            program.drive(world, next_s)
        yield t_s, score
