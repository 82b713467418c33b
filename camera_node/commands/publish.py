# SPDX-License-Identifier: BSD-3-Clause
"""`python -m camera_node`: publishes the detections of one camera."""

import contextlib
import time
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from camera_node.commands.relative_settings import RelativeSettings
from camera_node.foundation.config import example_file, require_name
from camera_node.foundation.errors import ConfigError
from camera_node.foundation.service import ServiceManager, StopEvent, stopped_by_signals
from camera_node.protocol.registration import CameraRegistration
from camera_node.protocol.server_connection import LOCAL_SERVER, ConnectionOptions
from camera_node.simulation.simulated_camera import SimulatedCamera
from camera_node.sources.drivers import SourceIdentity, driver_of, identify, is_simulation
from camera_node.sources.frame import Source, SourceSettings, is_url
from camera_node.sources.network_stream import open_stream
from camera_node.sources.recorded_frames import ArenaTime, FrameFolder, PacedSource, VideoFile

if typing.TYPE_CHECKING:
    import zenoh

    from camera_node.detection.detector import Detector
    from camera_node.node.node import Node


@dataclass(frozen=True)
class Publish:
    """Publish every roundel of every frame of one camera over Zenoh, until stopped.

    Without --name the server gives the camera its name and stores its settings.
    """

    source: str
    """A camera by number (0), path (/dev/video2) or name; genicam:SERIAL; picamera:NUMBER; the address of a stream; a
    video file; a folder of <t_ns>.png|jpg; or sim, or sim:NAME for a camera of the scene."""
    name: str | None = None
    """The camera's name in the arena and in rig.yaml, such as cam0; the server's choice unless given."""
    connection: ConnectionOptions = LOCAL_SERVER
    detector: Literal["chords", "paper"] = "chords"
    """The search method; paper is the reference method of Faigl et al., ICRA 2013."""
    inner_ratios: tuple[float, ...] = ()
    """Inner over outer diameters of the prints in use, such as 0.6; without any, they are found."""
    listen: tuple[str, ...] = ()
    """Run without a server, as on a robot: be the Zenoh router that listens on these endpoints, such as
    tcp/127.0.0.1:7447, to which the robot's programs connect. Requires --name; --connect is not used."""
    relative: Annotated[RelativeSettings, tyro.conf.OmitArgPrefixes] = field(default_factory=RelativeSettings)
    settings: Annotated[SourceSettings, tyro.conf.OmitArgPrefixes] = field(default_factory=SourceSettings)

    def run(self) -> None:
        """Open the source and the session, publish until the source ends or a signal arrives, and close both."""
        import cv2

        self._check()
        cv2.setNumThreads(1)  # a machine runs one process for each of its cameras
        with stopped_by_signals() as stop:
            if self.name is not None:
                return self._publish_named(self.name, stop)
            identity, first_t_ns = identify(self.source), first_time(self.source, self.settings)
            self._detector()
            session = self._open_session(stop)
            if session is not None:
                with session:
                    self._publish_registered(session, identity, first_t_ns, stop)

    def _check(self) -> None:
        require_name(self.connection.arena, "an arena")
        if self.name is not None:
            require_name(self.name, "a camera")
        elif self.listen:
            raise ConfigError("--listen runs without a server, which would name the camera; give --name")
        self.relative.check()

    def _publish_named(self, name: str, stop: StopEvent) -> None:
        with contextlib.ExitStack() as stack:
            source = open_source(self.source, self.settings, name)
            stack.callback(source.close)
            self._detector()  # its settings may be invalid
            self.relative.localizer(name)
            if (session := self._open_session(stop)) is None:
                return
            stack.enter_context(session)
            keeps_stamps = source.is_recording and self.settings.stamps == "recorded"
            node = self._node(name, source, session, keeps_stamps)
            with stop.closing(node.close):
                node.run()

    def _open_session(self, stop: StopEvent) -> "zenoh.Session | None":
        """Wait for the server, if there is to be one; the service is ready while it waits. None once `stop` is set."""
        from camera_node.protocol.session import open_router

        if self.listen:
            return open_router(self.listen, self.connection.zenoh)
        with contextlib.ExitStack() as stack:
            service = stack.enter_context(ServiceManager())

            def report() -> None:
                service.ready()
                service.report("waits for a server")
                service.progress()

            session = self.connection.wait().wait_unless(stop, report)
            if session is not None:
                stack.pop_all()  # the service goes on
            return session

    def _publish_registered(
        self, session: "zenoh.Session", identity: SourceIdentity, first_t_ns: int | None, stop: StopEvent
    ) -> None:
        """Publish under the name that the server gives; start again under each new name."""
        from camera_node.node.node import RegisteredNode
        from camera_node.node.server_registration import Registration, camera_id

        request = CameraRegistration(
            id=camera_id(identity.key),
            driver=identity.driver,
            source=identity.label,
            width=self.settings.width or 0,
            height=self.settings.height or 0,
            name=identity.name,
            first_t_ns=first_t_ns,
        )
        registration = Registration(session, self.connection.arena, request)
        if (assignment := registration.ask(stop)) is None:
            return
        arena_time = ArenaTime.of(assignment)
        with contextlib.closing(registration):
            registered = RegisteredNode(registration)
            while assignment is not None and not stop.is_set():
                source = open_source(self.source, self.settings, assignment.name, arena_time)
                with contextlib.closing(source):
                    node = self._node(assignment.name, source, session, source.is_recording)
                    with stop.closing(node.close):
                        assignment = registered.run(node, assignment)

    def _node(self, name: str, source: Source, session: "zenoh.Session", keep_stamps: bool) -> "Node":
        from camera_node.node.node import Node, NodeOptions

        options = NodeOptions(
            self.connection.arena, keep_stamps, self.relative.localizer(name), bool(self.listen)
        )
        return Node(name, source, self._detector(), session, options)

    def _detector(self) -> "Detector":
        from camera_node.detection.detector import Detector

        return Detector(detector=self.detector, inner_ratios=self.inner_ratios)


def open_source(
    text: str, settings: SourceSettings, name: str = "cam0", arena_time: ArenaTime | None = None
) -> Source:
    """Open the source that `--source` names: `sim`, a folder, a video file, the address of a stream, or a
    camera of a driver.

    Args:
        text: the value of `--source`.
        settings: each kind of source uses those that apply to it.
        name: the camera's name in a simulated arena, unless `text` has it, as in `sim:north`.
        arena_time: recordings play as live cameras in this time, whatever `settings` say, and so do simulations
            without an epoch.

    Raises:
        CameraError: the source does not exist or does not open.
        ConfigError: a setting is invalid, or a simulation has no scene.
    """
    settings.check()
    if is_simulation(text):
        return _open_simulation(settings, text.partition(":")[2] or name, arena_time)
    if is_url(text):
        return open_stream(text)
    if Path(text).is_dir():
        return PacedSource(FrameFolder(Path(text)), settings, arena_time)
    if Path(text).is_file():
        return PacedSource(VideoFile(Path(text), settings.fps), settings, arena_time)
    driver, camera = driver_of(text)
    return driver.open(camera, settings)


def first_time(text: str, settings: SourceSettings) -> int | None:
    """The time of a recording's or a simulation's first frame by its own clock, ns; None for cameras."""
    if is_simulation(text):
        return 0
    if Path(text).is_dir():
        return int(FrameFolder(Path(text)).files[0].stem)
    if Path(text).is_file():
        times = VideoFile(Path(text), settings.fps).times
        return times[0] if times else 0
    return None


def _open_simulation(settings: SourceSettings, name: str, arena_time: ArenaTime | None) -> Source:
    scene = settings.scene or example_file("demo/scene.yaml")
    epoch_ns = time.time_ns() if settings.epoch_ns is None else settings.epoch_ns
    if arena_time is not None and settings.epoch_ns is None:
        epoch_ns = arena_time.shift_ns - arena_time.ahead_ns
    return SimulatedCamera(scene, name, epoch_ns)
