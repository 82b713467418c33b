# SPDX-License-Identifier: BSD-3-Clause
"""`python -m web`: watch an arena or its recording, in the browser or on one line a second; or start a demo."""

import contextlib
import signal
import threading
from dataclasses import dataclass
from pathlib import Path

import tyro

from camera_node.errors import run
from camera_node.protocol.session import open_client
from web.feed import Feed
from web.replay import RecordingPlayer
from web.subscription import Subscription
from web.tables import describe


@dataclass(frozen=True, kw_only=True)
class Options:
    """Watch an arena.

    Attributes:
        connect: Zenoh endpoints of the server.
        arena: Name of the arena, as in the server's configuration.
        zenoh: A Zenoh configuration (JSON5) for TLS, access control or scouting.
        host: Address that the page is served on; 0.0.0.0 shows it to the whole network.
        port: Port that the page is served on.
        headless: One line a second instead of a page.
        seconds: End after so long; of a demo, so long after calibration.
        demo: Start a simulated arena, calibrate it by a wand wave, track its robots, and watch it.
        rig: The arena's rig.yaml (lenses at the least), for a button that places its cameras by a waved wand.
        wand: The wand that is waved.
        replay: Show a recording (MCAP, by python -m fusion record) instead of a running arena.
        scene: The demo's scene; arena.yaml, robots.yaml and wand.yaml lie beside it. The checkout's own by default.
        listen: Zenoh endpoint of the demo's server, as tcp/127.0.0.1:7447; a free one by default.
    """

    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    arena: str = "arena"
    zenoh: Path | None = None
    host: str = "127.0.0.1"
    port: int = 8080
    headless: bool = False
    seconds: float | None = None
    demo: bool = False
    rig: Path | None = None
    wand: Path = Path("configs/wand.yaml")
    replay: Path | None = None
    scene: Path | None = None
    listen: str | None = None


def watch(options: Options, stop: threading.Event) -> None:
    """Show the arena until `stop` is set."""
    session = open_client(options.connect, options.zenoh)
    try:
        feed = Feed(options.arena)
        _show(feed, Subscription(session, feed), options, stop)
    finally:
        session.close()


def replay(path: Path, options: Options, stop: threading.Event) -> None:
    """Show a recording until `stop` is set; without a page, until it ends."""
    recorded = RecordingPlayer(path)
    feed = Feed(recorded.arena, clock=recorded.seconds)
    teller = threading.Thread(target=recorded.run, args=(feed, stop, options.headless))
    teller.start()
    try:
        _show(feed, recorded, options, stop)
    finally:
        stop.set()
        teller.join()


def _show(
    feed: Feed, source: Subscription | RecordingPlayer, options: Options, stop: threading.Event
) -> None:
    if options.headless:
        ended = False
        while not ended:
            ended = stop.wait(1.0)
            print(describe(feed.latest()), flush=True)
        return
    from web.calibrating import Calibrating, Files
    from web.controls import LiveControls
    from web.picking import Picking
    from web.playback import ReplayControls
    from web.view import View

    files = Files(options.rig, options.wand) if options.rig is not None else None
    if files is not None:
        files.check()
    with contextlib.ExitStack() as stack:
        view = View(feed, options.host, options.port)
        stack.callback(view.close)
        if isinstance(source, RecordingPlayer):
            view.add(ReplayControls(view.server, source))
        else:
            if files is not None:
                stack.callback(Calibrating(view.server, source, files).close)
            view.add(LiveControls(view.server, source))
            view.add(Picking(view.server, source))
        print(f"open {view.url} in a browser; Ctrl-C ends", flush=True)
        view.run(stop)


def play(options: Options) -> int:
    """Play the demo; returns its exit code."""
    from web.demo import default_scene, run_demo
    from web.view import check_port

    if not options.headless:
        check_port(options.host, options.port)
    page = None if options.headless else (options.host, options.port)
    return run_demo(options.scene or default_scene(), options.listen, page, options.seconds)


def program() -> int | None:
    options = tyro.cli(Options, prog="python -m web")
    if options.demo:
        return play(options)
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    if options.seconds is not None:
        threading.Timer(options.seconds, stop.set).start()
    if options.replay is not None:
        replay(options.replay, options, stop)
    else:
        watch(options, stop)
    return 0


def main() -> None:
    run(program)


if __name__ == "__main__":
    main()
