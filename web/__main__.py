# SPDX-License-Identifier: BSD-3-Clause
"""`python -m web`: shows an arena or a recording in the browser or in one line per second, or runs the demo."""

import contextlib
import logging
import os
import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

# Before NumPy is loaded, as in fusion.__main__: the page calibrates cameras.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from camera_node.foundation.command_line import parse
from camera_node.foundation.config import example_file
from camera_node.foundation.logs import set_up_logging
from camera_node.foundation.program import run
from camera_node.foundation.service import stopped_by_signals
from camera_node.protocol.server_connection import ServerConnection
from web.state.feed import Feed
from web.state.replay import RecordingPlayer
from web.state.subscription import Subscription
from web.tables import describe_arena


@dataclass(frozen=True, kw_only=True)
class Options:
    """Show an arena.

    Attributes:
        connect: Zenoh endpoints of the server.
        arena: Name of the arena, as in the server's configuration.
        zenoh: A Zenoh configuration (JSON5) for TLS, access control or scouting.
        host: Address of the page; 0.0.0.0 makes it available to the whole network, with tokens in its addresses.
        port: Port of the page.
        tokens: A file with the page's tokens, created if it does not exist; without it they change at each start.
        origin: Origins of reverse proxies in front of the page, such as https://lab.example.org.
        headless: Print one line per second instead of serving a page.
        seconds: End after this time; in the demo, this long after the calibration.
        demo: Run a simulated arena: calibrate it with a wand, track its robots and show it.
        rig: The arena's rig.yaml with at least the intrinsics; adds a button that calibrates with a wand.
        wand: The wand for that button.
        folder: Where the page saves recordings and robots, and lists recordings.
        replay: Show a recording (MCAP, from roundel record) instead of a running arena.
        scene: The demo's scene, with arena.yaml, robots.yaml and wand.yaml beside it; by default the one in configs.
        listen: Zenoh endpoint of the demo's server; by default tcp/127.0.0.1:7447, or a free port if that is taken.
    """

    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    arena: str = "arena"
    zenoh: Path | None = None
    host: str = "127.0.0.1"
    port: int = 8080
    tokens: Path | None = None
    origin: tuple[str, ...] = ()
    headless: bool = False
    seconds: float | None = None
    demo: bool = False
    rig: Path | None = None
    wand: Path = field(default_factory=partial(example_file, "wand.yaml"))
    folder: Path = Path()
    replay: Path | None = None
    scene: Path | None = None
    listen: str | None = None


def show_live(options: Options, stop: threading.Event) -> None:
    """Show a running arena until `stop` is set."""
    with ServerConnection(options.connect, options.zenoh) as connection:
        feed = Feed(options.arena)
        _show(feed, Subscription(connection, feed), options, stop)


def show_recording(path: Path, options: Options, stop: threading.Event) -> None:
    """Show a recording until `stop` is set; without a page, until it ends."""
    player = RecordingPlayer(path)
    feed = Feed(player.arena, clock=player.seconds)
    thread = threading.Thread(target=player.run, args=(feed, stop, options.headless))
    thread.start()
    try:
        _show(feed, player, options, stop)
    finally:
        stop.set()
        thread.join()


def _show(
    feed: Feed, source: Subscription | RecordingPlayer, options: Options, stop: threading.Event
) -> None:
    if options.headless:
        _print_lines(feed, stop)
        return
    from web.page import add_live_page, add_replay_page
    from web.page_access import PageAccess
    from web.tabs.wand_session import CalibrationFiles
    from web.view import View

    files = CalibrationFiles(options.rig, options.wand) if options.rig is not None else None
    if files is not None:
        files.check()
    with contextlib.ExitStack() as stack:
        access = PageAccess.create(options.host, options.port, options.tokens, options.origin)
        view = View(feed, access)
        stack.callback(view.close)
        if isinstance(source, RecordingPlayer):
            add_replay_page(view, source)
        else:
            add_live_page(view, source, " ".join(options.connect), files, stack, options.folder)
        print(*access.instructions(options.tokens), sep="\n", flush=True)
        view.run(stop)


def _print_lines(feed: Feed, stop: threading.Event) -> None:
    """Print the state every second, and once more at the end."""
    ended = False
    while not ended:
        ended = stop.wait(1.0)
        print(describe_arena(feed.state()), flush=True)


def play_demo(options: Options) -> int:
    """Run the demo and return its exit code."""
    from web.demo.demo import run_demo
    from web.view import check_port

    if not options.headless:
        check_port(options.host, options.port)
    page = None if options.headless else (options.host, options.port)
    return run_demo(options.scene or example_file("demo/scene.yaml"), options.listen, page, options.seconds)


def program(arguments: Sequence[str], prog: str = "python -m web", examples: Sequence[str] = ()) -> int:
    """Run a command line and return the exit code."""
    options = parse(Options, prog, arguments, examples)
    if options.demo:
        return play_demo(options)
    with stopped_by_signals() as stop:
        if options.seconds is not None:
            threading.Timer(options.seconds, stop.set).start()
        if options.replay is not None:
            show_recording(options.replay, options, stop)
        else:
            show_live(options, stop)
    return 0


def main() -> None:
    set_up_logging(logging.WARNING)
    run(lambda: program(sys.argv[1:]))


if __name__ == "__main__":
    main()
