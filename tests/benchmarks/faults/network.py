# SPDX-License-Identifier: BSD-3-Clause
"""The network of an arena: loopback, or one network namespace for each program with a link to the server's bridge."""

import os
import shutil
import subprocess
from collections.abc import Sequence
from contextlib import ExitStack
from itertools import count

COUNT = count()  # of networks: the names of one that was deleted are free a little later
SUBNETS = 250  # private, 10.213.x: two processes rarely have the same


class Loopback:
    """All programs on this machine's loopback address."""

    host = "127.0.0.1"

    def command(self, name: str, command: list[str]) -> list[str]:
        """The command line that runs a program at its place."""
        return command


class Namespaces(Loopback):
    """A namespace with a bridge for the server, and one with a link to it for each camera; a context manager.

    Args:
        cameras: the names of the programs that have a namespace of their own; others run beside the server.
    """

    def __init__(self, cameras: Sequence[str]) -> None:
        self._subnet = f"10.213.{os.getpid() % SUBNETS}"
        self.host = f"{self._subnet}.1"  # this process has .2, and the programs follow
        self._number = f"{os.getpid() % 10**6}{next(COUNT) % 10}"
        self._prefix = f"rdl{self._number}"
        self._server = f"{self._prefix}-server"
        self._namespace = {name: f"{self._prefix}-{name}" for name in cameras}
        self._link = {name: f"v{self._number}c{k}" for k, name in enumerate(cameras)}
        self._stack = ExitStack()

    def __enter__(self) -> "Namespaces":
        with self._stack as stack:
            self._add_namespace(self._server, stack)
            in_server = ("ip", "-n", self._server)
            run(*in_server, "link", "add", "br0", "type", "bridge")
            run(*in_server, "address", "add", f"{self.host}/24", "dev", "br0")
            run(*in_server, "link", "set", "br0", "up")
            self._connect(f"v{self._number}", None, 2)
            for k, (name, namespace) in enumerate(self._namespace.items()):
                self._add_namespace(namespace, stack)
                self._connect(self._link[name], namespace, 10 + k)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *exception: object) -> None:
        self._stack.close()

    def command(self, name: str, command: list[str]) -> list[str]:
        return ["ip", "netns", "exec", self._namespace.get(name, self._server), *command]

    def set_link(self, camera: str, is_up: bool) -> None:
        """Take the link of a camera down, as if its cable at the switch were pulled out, or up."""
        run("ip", "-n", self._server, "link", "set", self._link[camera], "up" if is_up else "down")

    def limit(self, camera: str, bits_per_s: int) -> None:
        """Limit the rate at which a camera can send, by a token bucket."""
        bucket = ("tbf", "rate", f"{bits_per_s}bit", "burst", "10kb", "latency", "400ms")
        run("tc", "-n", self._namespace[camera], "qdisc", "replace", "dev", "eth0", "root", *bucket)

    def _add_namespace(self, name: str, stack: ExitStack) -> None:
        run("ip", "netns", "add", name)
        stack.callback(run, "ip", "netns", "delete", name)
        run("ip", "-n", name, "link", "set", "lo", "up")

    def _connect(self, link: str, namespace: str | None, number: int) -> None:
        """A pair of interfaces: `link` at the bridge, eth0 in the namespace; None for that of this process."""
        inside = "eth0" if namespace else f"{link}r"
        within = ("ip", "-n", namespace) if namespace else ("ip",)
        place = ("netns", namespace) if namespace else ()
        run("ip", "-n", self._server, "link", "add", link, "type", "veth", "peer", "name", inside, *place)
        if not namespace:
            run("ip", "-n", self._server, "link", "set", inside, "netns", "1")
        run(*within, "address", "add", f"{self._subnet}.{number}/24", "dev", inside)
        run(*within, "link", "set", inside, "up")
        run("ip", "-n", self._server, "link", "set", link, "master", "br0", "up")


def run(*command: str) -> None:
    """Run a command; raise RuntimeError with its message if it fails."""
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)}: {done.stderr.strip()}")


def why_not() -> str:
    """Why this machine can't run namespaces; empty if it can."""
    if not (shutil.which("ip") and shutil.which("tc")):
        return "ip and tc (iproute2) are not installed"
    probe = f"rdl{os.getpid()}-probe"
    try:
        run("ip", "netns", "add", probe)
    except RuntimeError as error:
        return f"network namespaces can't be created: {error}"
    try:
        run("ip", "-n", probe, "link", "add", "v0", "type", "veth", "peer", "name", "v1")
        run(
            "tc",
            "-n",
            probe,
            "qdisc",
            "replace",
            "dev",
            "v0",
            "root",
            "tbf",
            "rate",
            "1mbit",
            "burst",
            "10kb",
            "latency",
            "400ms",
        )
    except RuntimeError as error:
        return str(error)
    finally:
        run("ip", "netns", "delete", probe)
    return ""
