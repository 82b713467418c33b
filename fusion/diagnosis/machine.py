# SPDX-License-Identifier: BSD-3-Clause
"""Checks this machine and the files of an arena; needs no server."""

import errno
import os
import platform
import re
import shutil
import socket
import subprocess
from collections.abc import Iterator
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import zenoh

from calib.rig.rig import Rig, load_rig
from camera_node.foundation.errors import RoundelError
from fusion.diagnosis.findings import Finding
from fusion.model.robots import load_robots
from fusion.protocol.arena_health import assess_calibration, calibration_problems, describe_calibration
from fusion.server.arena_config import ArenaConfig

PACKAGES = ("roundel", "eclipse-zenoh", "numpy", "opencv-python-headless", "gtsam", "scipy", "mcap", "viser")
CERTIFICATES = ("root_ca_certificate", "listen_certificate", "connect_certificate")
RENEW_DAYS = 30
MIN_FREE_GB = 2.0
INSTALL = "install it with python -m pip install '.[server]'"
RENEW = "renew it as docs/security.md describes"


def check_versions() -> Finding:
    """The versions of Python and of the packages that a server needs."""
    found, missing = [f"Python {platform.python_version()}"], []
    for package in PACKAGES:
        try:
            found.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            missing.append(package)
    if missing:
        return Finding("error", "versions", f"{', '.join(missing)} is missing", INSTALL)
    return Finding("ok", "versions", ", ".join(found))


def check_listening(config: ArenaConfig, is_reached: bool) -> Iterator[Finding]:
    """Whether a server can listen on its endpoints, or does so already (`is_reached`)."""
    for endpoint in config.listen:
        match = re.search(r"/\[?([^\]/]+)\]?:(\d+)", endpoint)
        if match is None:
            yield Finding("warning", "ports", f"{endpoint} is not checked: it has no port")
            continue
        if is_reached:
            yield Finding("ok", "ports", f"the server answers at {endpoint}")
            continue
        yield _check_address(endpoint, match[1], int(match[2]))


def _check_address(endpoint: str, host: str, port: int) -> Finding:
    try:
        with socket.create_server((host, port)):
            return Finding("ok", "ports", f"{endpoint} is free")
    except OSError as error:
        remedies = {
            errno.EADDRINUSE: "stop the program that uses it (ss -ltnp shows it), or change listen in arena.yaml",
            errno.EADDRNOTAVAIL: "use an address of this machine (ip address shows them), or 0.0.0.0",
            errno.EACCES: "use a port above 1023",
        }
        reason = os.strerror(error.errno) if error.errno and error.errno > 0 else str(error)
        return Finding(
            "error", "ports", f"{endpoint}: {reason}", remedies.get(error.errno or 0, "change listen")
        )


def check_certificates(zenoh_config: Path | None, now: datetime) -> Iterator[Finding]:
    """When the certificates of a Zenoh configuration expire; their paths start from the working folder."""
    if zenoh_config is None:
        yield Finding(
            "ok", "certificates", "none: everybody who reaches the port is trusted, see docs/security.md"
        )
        return
    try:
        config = zenoh.Config.from_file(str(zenoh_config))
    except zenoh.ZError as error:
        yield Finding("error", "certificates", f"{zenoh_config} is invalid: {error}", "correct the file")
        return
    names = (config.get_json(f"transport/link/tls/{name}").strip('"') for name in CERTIFICATES)
    for path in dict.fromkeys(Path(name) for name in names if name not in ("null", "")):
        yield _check_certificate(path, now)


def _check_certificate(path: Path, now: datetime) -> Finding:
    command = ["openssl", "x509", "-noout", "-enddate", "-in", str(path)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
        text = done.stdout.strip().removeprefix("notAfter=")
        left = datetime.strptime(text, "%b %d %H:%M:%S %Y %Z").replace(tzinfo=UTC) - now
    except FileNotFoundError:
        return Finding("warning", "certificates", f"{path} is not checked", "install openssl")
    except (subprocess.SubprocessError, ValueError):
        return Finding(
            "error", "certificates", f"{path} is missing or is no certificate", "create it: docs/security.md"
        )
    if left.days < 0:
        return Finding("error", "certificates", f"{path} expired {-left.days} days ago", RENEW)
    level = "warning" if left.days < RENEW_DAYS else "ok"
    return Finding(
        level, "certificates", f"{path} expires in {left.days} days", RENEW if level != "ok" else ""
    )


def check_disk(folder: Path) -> Finding:
    """The space for recordings and saved files."""
    free_gb = shutil.disk_usage(folder).free / 1e9
    state = f"{free_gb:.1f} GB free in {folder.resolve()}"
    if not os.access(folder, os.W_OK):
        return Finding(
            "error", "disk", f"{folder.resolve()} is not writable", "give this user the right to write there"
        )
    if free_gb < MIN_FREE_GB:
        return Finding("warning", "disk", state, "delete old recordings")
    return Finding("ok", "disk", state)


def check_files(config: ArenaConfig, now: datetime) -> Iterator[Finding]:
    """The rig and the robots that a server with this configuration loads."""
    try:
        robots = load_robots(Path(config.robots))
        yield Finding("ok", "robots", f"{len(robots)} in {config.robots}")
    except RoundelError as error:
        yield Finding("error", "robots", str(error))
    files = [Path(file) for file in (config.saved_rig, config.rig) if file and Path(file).exists()]
    if not files:
        yield check_rig(None, now)
        return
    newest = max(files, key=lambda file: file.stat().st_mtime)
    try:
        yield check_rig(load_rig(newest), now)
    except RoundelError as error:
        yield Finding("error", "calibration", str(error))


def check_rig(rig: Rig | None, now: datetime) -> Finding:
    """The age and the grade of a rig."""
    calibration = assess_calibration(rig, now)
    state = describe_calibration(calibration)
    if problems := calibration_problems(calibration):
        return Finding("warning", "calibration", state, "; ".join(problems))
    return Finding("ok", "calibration", f"{calibration.placed} cameras, {state}")
