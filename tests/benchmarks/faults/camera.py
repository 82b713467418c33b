# SPDX-License-Identifier: BSD-3-Clause
"""A camera node without images: a real `Node` whose detector reports what the scene of a load shows.

It runs as a process of its own. Lines of JSON on its standard input (`CameraCommand`) give it faults.
"""

import contextlib
import math
import signal
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import tyro

from calib.rig.camera import Camera
from camera_node.detection.detector import Detector
from camera_node.detection.roundels import DetectedRoundels, Roundels
from camera_node.foundation.arrays import Grey
from camera_node.foundation.logs import set_up_logging
from camera_node.foundation.program import run
from camera_node.geometry.pose import Pose, rotation_from_vector
from camera_node.node.node import Node, NodeOptions
from camera_node.protocol.messages import MAX_ROUNDELS
from camera_node.protocol.session import open_client
from camera_node.sources.frame import Frame, Source
from tests.benchmarks.faults.world import CameraCommand, CameraFault, World
from tests.benchmarks.fusion_load import Load, Scene

READOUT_NS = 5_000_000
STAMP_SIGMA_NS = 20_000  # of a driver: no two frames have exactly the same stamp
UNKNOWN_PX2 = 1e4  # variance of what no image was fitted for: a node refines outlines by the lens and these
GREY = {"black": 0, "bright": 255}  # levels of the images; others are grey


def no_roundels() -> Roundels:
    """An empty frame."""
    ids = np.empty(0, np.int32)
    scalars = np.empty(0)
    return Roundels(
        np.empty((0, 2)), np.empty((0, 2, 2)), np.empty((0, 2)), scalars, scalars, scalars, ids, ids
    )


class SceneDetector(Detector):
    """Reports the roundels of the frame that the source delivered last."""

    current: Roundels = no_roundels()

    def detect(self, image: Grey) -> DetectedRoundels:
        columns = {name: getattr(self.current, name) for name in Roundels.__slots__}
        n = len(self.current)
        pose_cov = np.tile(UNKNOWN_PX2 * np.eye(7), (n, 1, 1))
        pose_cov[:, :2, :2] = self.current.cov
        return DetectedRoundels(**columns, offset_px=np.zeros((n, 2)), pose_cov=pose_cov)

    def adjusted(self, **changes: Any) -> Detector:
        super().adjusted(**changes)  # refuses invalid settings
        return self


class SceneCamera(Source):
    """Delivers the frames of one camera of a load at their times, with the faults of `fault`.

    Attributes:
        hz: its rate, that of the load unless it is set before the first frame.
        stamp_sigma_ns: of the errors of its stamps.
    """

    def __init__(self, world: World, name: str, detector: SceneDetector) -> None:
        self.hz, self.stamp_sigma_ns = world.load.hz, STAMP_SIGMA_NS
        self.dropped, self.fault = 0, CameraFault()
        self._shown = no_roundels()  # by the last frame
        self._held: list[tuple[Frame, Roundels]] = []  # of frames that arrive in the wrong order
        self._burst = False, 0  # whether frames arrive, and until when, ns
        self._world, self._scene, self._detector = world, Scene(world.load), detector
        self._name, self._index = name, self._scene.cameras.names.index(name)
        self._phase = world.load.phases()[self._index]
        self._rng = np.random.default_rng(self._index)
        lens = world.load.rig[name]
        self._images = {
            p: np.full((lens.height, lens.width), GREY.get(p, 128), np.uint8) for p in (*GREY, "")
        }
        self._closed = threading.Event()

    def __iter__(self) -> Iterator[Frame]:
        seq = self.next_after(-1, time.time_ns())
        while self._wait_until(self.due_ns(seq)):
            fault = self.fault
            for frame, roundels in self.deliver(seq):
                self._detector.current = roundels
                yield frame
            seq = self.next_after(seq, time.time_ns(), fault.delay_ms)

    def due_ns(self, seq: int) -> int:
        """The Unix time at which a frame is delivered."""
        return self._time_ns(seq) + READOUT_NS + round(self.fault.delay_ms * 1e6)

    def next_after(self, seq: int, now_ns: int, delay_ms: float = 0.0) -> int:
        """The number of the next frame; frames that were not fetched in time are skipped."""
        elapsed_s = (now_ns - self._world.epoch_ns - READOUT_NS) * 1e-9 - delay_ms * 1e-3
        return max(seq + 1, math.floor(elapsed_s * self.hz - self._phase) + (seq < 0))

    def deliver(self, seq: int) -> list[tuple[Frame, Roundels]]:
        """The frames that become available with this one: none, one, or two."""
        fault = self.fault
        if fault.silent or self._rng.random() < fault.loss or self._is_between_bursts(seq):
            return []
        self._held += [self._expose(self._time_ns(seq), fault)] * (2 if fault.doubled else 1)
        if fault.swapped and len(self._held) < 2:
            return []
        delivered, self._held = self._held[::-1], []
        return delivered

    def _is_between_bursts(self, seq: int) -> bool:
        means_s, t_ns, (arrives, until_ns) = self.fault.bursts_s, self._time_ns(seq), self._burst
        if means_s is None:
            return False
        while until_ns < t_ns:
            arrives = not arrives
            until_ns = max(until_ns, self.fault.since_ns)
            until_ns += round(self._rng.exponential(means_s[0 if arrives else 1]) * 1e9)
        self._burst = arrives, until_ns
        return not arrives

    def place(self, fault: CameraFault) -> None:
        """Set the faults, and the true pose and focal length of the camera."""
        self._scene.cameras.place({self._name: displaced(self._world.load.rig[self._name], fault)})
        self.fault = fault

    @property
    def true_camera(self) -> Camera:
        """The camera with its true pose and focal length."""
        return self._scene.cameras[self._name]

    def close(self) -> None:
        self._closed.set()

    def _expose(self, t_ns: int, fault: CameraFault) -> tuple[Frame, Roundels]:
        world = self._world
        image = self._images[fault.picture if fault.picture in GREY else ""]
        stamp_ns = fault.stamp_ns(t_ns) + round(self._rng.normal() * self.stamp_sigma_ns)
        if fault.picture in GREY:
            return Frame(image, stamp_ns), no_roundels()
        if fault.picture == "frozen":
            return Frame(image, stamp_ns), self._shown
        roundels = self._scene.roundels(self._index, world.states(t_ns), self._rng, world.hidden(t_ns))
        if fault.false:
            roundels = joined(roundels, self._false(min(fault.false, MAX_ROUNDELS - len(roundels))))
        self._shown = roundels
        return Frame(image, stamp_ns), roundels

    def _false(self, n: int) -> Roundels:
        camera, rng = self._world.load.rig[self._name], self._rng
        axes = np.sort(rng.uniform(10, 30, (n, 2)))[:, ::-1]
        cov, level, none = np.tile(0.01 * np.eye(2), (n, 1, 1)), np.full(n, 0.6), np.full(n, -1, np.int32)
        uv = rng.uniform([0, 0], [camera.width - 1, camera.height - 1], (n, 2))
        return Roundels(uv, cov, axes, rng.uniform(-1.5, 1.5, n), level, 200 * level, none, none)

    def _time_ns(self, seq: int) -> int:
        return self._world.epoch_ns + round((seq + self._phase) / self.hz * 1e9)

    def _wait_until(self, t_ns: int) -> bool:
        return not self._closed.wait(max(0, t_ns - time.time_ns()) * 1e-9)


def displaced(camera: Camera, fault: CameraFault) -> Camera:
    """A calibrated camera with its true pose and focal length."""
    T, scale = np.eye(4), fault.focal_scale
    T[:3, :3], T[:3, 3] = rotation_from_vector(np.array(fault.turn_rad)), fault.shift_m
    moved = Pose.from_matrix(camera.matrix() @ T)
    return msgspec.structs.replace(camera, T_world_cam=moved, fx=camera.fx * scale, fy=camera.fy * scale)


def joined(a: Roundels, b: Roundels) -> Roundels:
    """The roundels of both."""
    return Roundels(*(np.concatenate([getattr(a, k), getattr(b, k)]) for k in Roundels.__slots__))


def obey(camera: SceneCamera, world: World) -> None:
    """Execute the commands on standard input."""
    for line in sys.stdin.buffer:
        command = msgspec.json.decode(line, type=CameraCommand)
        if command.event is not None:
            world.events[command.event.robot] = command.event
        if command.fault is not None:
            camera.place(command.fault)


def main(name: str, connect: str, arena: str, epoch_ns: int, load: str, view: str = "") -> None:
    """Publish until SIGTERM.

    Args:
        name: under which it publishes.
        connect: Zenoh endpoint of the server.
        arena: its name.
        epoch_ns: Unix time of the load's time 0.
        load: the `Load` as JSON.
        view: the camera of the load whose view it has; without one, that of its name.
    """
    set_up_logging()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    world = World(msgspec.json.decode(load, type=Load), epoch_ns)
    detector = SceneDetector()
    camera = SceneCamera(world, view or name, detector)
    threading.Thread(target=obey, args=(camera, world), daemon=True).start()
    with contextlib.suppress(KeyboardInterrupt), open_client([connect]) as session:
        Node(name, camera, detector, session, NodeOptions(arena)).run()


if __name__ == "__main__":
    run(lambda: tyro.cli(main))
