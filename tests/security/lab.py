# SPDX-License-Identifier: BSD-3-Clause
"""A server process with the configuration from configs/zenoh, and sessions with any certificate."""

import contextlib
import json
import shutil
import subprocess
import sys
from pathlib import Path

import zenoh

from camera_node.protocol.messages import Keys
from camera_node.protocol.session import open_client
from tests.conftest import ROOT
from tests.waiting import wait_for

ARENA = "arena"
KEYS = Keys(ARENA)
CONFIGS = ROOT / "configs" / "zenoh"
SCRIPT_S = 60.0


def certificates(*words: str | Path) -> subprocess.CompletedProcess[str]:
    """Run certificates.sh."""
    command = ["sh", str(CONFIGS / "certificates.sh"), *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=SCRIPT_S, check=False)


class Lab:
    """A server process in `folder/server`, where certificates.sh put its certificate and its rules.

    Attributes:
        folder: the folder of the certificates.
        port: the server's port.
    """

    def __init__(self, folder: Path, closing: contextlib.ExitStack) -> None:
        self.folder, self._closing = folder, closing
        home = folder / "server"
        if not (home / "arena.yaml").exists():
            shutil.copy(ROOT / "configs" / "robots.yaml", home)
            (home / "arena.yaml").write_text(
                "listen: [tls/127.0.0.1:0]\nzenoh: zenoh/server.json5\nrobots: robots.yaml\n"
            )
        endpoints = home / "endpoints"
        endpoints.unlink(missing_ok=True)
        log = closing.enter_context((folder / "log").open("w"))
        command = [sys.executable, "-m", "fusion", "--config", "arena.yaml", "--endpoints-file", "endpoints"]
        server = subprocess.Popen(command, cwd=home, stderr=log)
        closing.callback(server.wait, 30)
        closing.callback(server.terminate)
        wait_for(lambda: endpoints.exists() or server.poll() is not None)
        assert endpoints.exists(), (folder / "log").read_text()
        self.port = int(endpoints.read_text().strip().rpartition(":")[2])
        self.endpoint = f"tls/localhost:{self.port}"

    def config(self, name: str) -> Path:
        """member.json5 with absolute paths to a certificate."""
        path = self.folder / f"{name}.json5"
        path.write_text(
            (CONFIGS / "member.json5").read_text().replace('"tls/', f'"{self.folder / name}/tls/')
        )
        return path

    def session(self, name: str) -> zenoh.Session:
        """A session with a certificate, as programs of Roundel open it; it has reached the server."""
        session = self._closing.enter_context(open_client([self.endpoint], self.config(name)))
        wait_for(lambda: session.info.routers_zid())
        return session

    def bare_session(self, name: str, mode: str) -> zenoh.Session:
        """A session in another of Zenoh's modes, `client` or `peer`, as programs in other languages open it."""
        config = zenoh.Config.from_file(str(self.config(name)))
        options = {
            "mode": mode,
            "listen/endpoints": [],
            "connect/endpoints": [self.endpoint],
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
        }
        for key, value in options.items():
            config.insert_json5(key, json.dumps(value))
        return self._closing.enter_context(zenoh.open(config))
