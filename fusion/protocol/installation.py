# SPDX-License-Identifier: BSD-3-Clause
"""The versions of this program and of what it needs."""

import contextlib
import platform
from importlib.metadata import PackageNotFoundError, version

import msgspec

from camera_node.protocol.messages import VERSION

PACKAGES = ("roundel", "eclipse-zenoh", "numpy", "opencv-python-headless", "gtsam", "scipy", "mcap", "viser")


class Installation(msgspec.Struct, frozen=True, kw_only=True):
    """The first message of a public recording, on the key `<arena>/recording`: with what it was made."""

    version: int = VERSION
    python: str
    platform: str
    packages: dict[str, str]  # name and version


def installation() -> Installation:
    """That of this program."""
    found = {}
    for package in PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            found[package] = version(package)
    return Installation(python=platform.python_version(), platform=platform.platform(), packages=found)
