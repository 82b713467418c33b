# SPDX-License-Identifier: BSD-3-Clause
"""`roundel view`: an arena or a recording in the browser, or in one line per second."""

import contextlib
import threading
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from camera_node.foundation.config import example_file
from camera_node.foundation.service import stopped_by_signals
from camera_node.protocol.server_connection import LOCAL_SERVER, ConnectionOptions
from web.roundel.demo import RunDemo
from web.state.feed import Feed
from web.state.recording_player import RecordingPlayer
from web.state.subscription import Subscription
from web.tables import describe_arena


@dataclass(frozen=True, kw_only=True)
class ViewArena:
    """Show an arena."""

    connection: ConnectionOptions = LOCAL_SERVER
    host: str = "127.0.0.1"
    """Address of the page; 0.0.0.0 makes it available to the whole network, with tokens in its addresses."""
    port: int = 8080
    """Port of the page."""
    tokens: Path | None = None
    """A file with the page's tokens, created if it does not exist; without it they change at each start."""
    origin: tuple[str, ...] = ()
    """Origins of reverse proxies in front of the page, such as https://lab.example.org."""
    headless: bool = False
    """Print one line per second instead of serving a page."""
    seconds: float | None = None
    """End after this time; in the demo, this long after the calibration."""
    demo: bool = False
    """Run a simulated arena: calibrate it with a wand, track its robots and show it."""
    rig: Path | None = None
    """The arena's rig.yaml with at least the intrinsics; adds a button that calibrates with a wand."""
    wand: Path = field(default_factory=partial(example_file, "wand.yaml"))
    """The wand for that button."""
    folder: Path = Path()
    """Where the page saves recordings and robots, and lists recordings."""
    replay: Path | None = None
    """Show a recording (MCAP, from roundel record) instead of a running arena."""
    scene: Path | None = None
    """The demo's scene, with arena.yaml, robots.yaml and wand.yaml beside it; by default the one in configs."""
    listen: str | None = None
    """Zenoh endpoint of the demo's server; by default tcp/127.0.0.1:7447, or a free port if that is taken."""

    def run(self) -> int:
        """Show it until stopped; return the exit code."""
        if self.demo:
            return RunDemo(
                headless=self.headless,
                seconds=self.seconds,
                host=self.host,
                port=self.port,
                scene=self.scene,
                listen=self.listen,
            ).run()
        with stopped_by_signals() as stop:
            if self.seconds is not None:
                threading.Timer(self.seconds, stop.set).start()
            if self.replay is not None:
                self.show_recording(self.replay, stop)
            else:
                self.show_live(stop)
        return 0

    def show_live(self, stop: threading.Event) -> None:
        """Show a running arena until `stop` is set."""
        with self.connection.wait() as connection:
            feed = Feed(self.connection.arena)
            self._show(feed, Subscription(connection, feed), stop)

    def show_recording(self, path: Path, stop: threading.Event) -> None:
        """Show a recording until `stop` is set; without a page, until it ends."""
        player = RecordingPlayer(path)
        feed = Feed(player.arena, clock=player.seconds)
        thread = threading.Thread(target=player.run, args=(feed, stop, self.headless))
        thread.start()
        try:
            self._show(feed, player, stop)
        finally:
            stop.set()
            thread.join()

    def _show(self, feed: Feed, source: Subscription | RecordingPlayer, stop: threading.Event) -> None:
        if self.headless:
            _print_lines(feed, stop)
            return
        from web.page import add_live_page, add_replay_page
        from web.page_access import PageAccess
        from web.tabs.wand_session import CalibrationFiles
        from web.view import View

        files = CalibrationFiles(self.rig, self.wand) if self.rig is not None else None
        if files is not None:
            files.check()
        with contextlib.ExitStack() as stack:
            access = PageAccess.create(self.host, self.port, self.tokens, self.origin)
            view = View(feed, access)
            stack.callback(view.close)
            if isinstance(source, RecordingPlayer):
                add_replay_page(view, source)
            else:
                add_live_page(view, source, " ".join(self.connection.connect), files, stack, self.folder)
            print(*access.instructions(self.tokens), sep="\n", flush=True)
            view.run(stop)


def _print_lines(feed: Feed, stop: threading.Event) -> None:
    """Print the state every second, and once more at the end."""
    ended = False
    while not ended:
        ended = stop.wait(1.0)
        print(describe_arena(feed.state()), flush=True)
