# SPDX-License-Identifier: BSD-3-Clause
"""`roundel camera --list`: the cameras that this machine reaches, by all drivers."""

import msgspec
from rich.table import Table

from camera_node.foundation.terminal import console, progress_console, say
from camera_node.sources.camera_description import CameraDescription, Mode
from camera_node.sources.drivers import all_cameras

SHOWN_SIZES = 4  # of one camera in the table


def list_cameras(as_json: bool) -> int:
    """Print all cameras with their modes, as a table or as JSON with all controls; 1 if there is none."""
    cameras, absent = all_cameras()
    if as_json:
        say(msgspec.json.format(msgspec.json.encode(cameras)).decode())
        return 0 if cameras else 1
    if cameras:
        console().print(_table(cameras))
    for fault in absent:
        say(f"not searched: {fault}", progress_console() if cameras else None)
    if not cameras:
        say(
            "no camera found; check power and cables. Network streams are not searched: give --source rtsp://..."
        )
    return 0 if cameras else 1


def _table(cameras: list[CameraDescription]) -> Table:
    table = Table("--source", "camera", "serial", "modes", "controls", "note")
    for camera in cameras:
        controls = str(len(camera.controls)) if camera.controls else ""
        table.add_row(
            camera.source, camera.name, camera.serial, _summary(camera.modes), controls, camera.note
        )
    return table


def _summary(modes: tuple[Mode, ...]) -> str:
    """The largest sizes, each with its pixel formats and its greatest rate."""
    sizes = sorted({(mode.width, mode.height) for mode in modes}, reverse=True)
    lines = []
    for width, height in sizes[:SHOWN_SIZES]:
        same = [mode for mode in modes if (mode.width, mode.height) == (width, height)]
        rate = max((mode.max_fps or 0.0 for mode in same), default=0.0)
        pixels = ", ".join(dict.fromkeys(mode.pixels.strip() for mode in same))
        lines.append(f"{width} x {height}{f' {rate:.0f} Hz' if rate else ''} ({pixels})")
    more = [f"and {len(sizes) - SHOWN_SIZES} smaller sizes"] if len(sizes) > SHOWN_SIZES else []
    return "\n".join(lines + more)
