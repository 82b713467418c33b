# SPDX-License-Identifier: BSD-3-Clause
"""`roundel demo`: a whole arena with simulated cameras."""

import sys
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from camera_node.foundation.config import example_file, shipped_path
from camera_node.foundation.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class RunDemo:
    """Calibrate four simulated cameras with a simulated wand, track three robots, and show them at
    http://localhost:8080. The exit code is 0 if the poses are correct.
    """

    relative: bool = False
    """Three robots hold a formation by what their own cameras locate, without a server, instead."""
    headless: bool = False
    """Serve no page."""
    seconds: float | None = None
    """End this long after the calibration; at Ctrl-C unless given."""
    host: str = "127.0.0.1"
    """Address of the page; 0.0.0.0 makes it available to the whole network, with tokens in its addresses."""
    port: int = 8080
    """Port of the page."""
    scene: Path | None = None
    """Another scene.yaml, with arena.yaml, robots.yaml and wand.yaml beside it."""
    listen: str | None = None
    """Zenoh endpoint of the server; tcp/127.0.0.1:7447 unless given, or a free port if that is taken."""

    def run(self) -> int:
        """Run the demo and return its exit code."""
        from web.view import check_port

        if self.relative and self.scene is not None:
            raise ConfigError("--scene is not for --relative, whose robots move by themselves")
        if not self.headless:
            check_port(self.host, self.port)
        page = None if self.headless else (self.host, self.port)
        if self.relative:
            sys.path.append(str(shipped_path("examples")))
            return import_module("formation.live_formation").run_formation(self.listen, page, self.seconds)
        from web.demo.arena_demo import run_demo

        return run_demo(self.scene or example_file("demo/scene.yaml"), self.listen, page, self.seconds)
