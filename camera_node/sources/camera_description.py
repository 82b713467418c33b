# SPDX-License-Identifier: BSD-3-Clause
"""What a driver states about a camera: its modes, its controls by name, and the check of a value before it is set."""

from collections.abc import Mapping
from typing import Literal

import msgspec

from camera_node.foundation.errors import ConfigError, most_similar
from camera_node.protocol.messages import ControlValue

SHOWN = 40  # names that an error lists


class Control(msgspec.Struct, frozen=True, omit_defaults=True):
    """One control.

    Attributes:
        name: as the driver calls it.
        kind: of its value; a button takes any value.
        low, high: least and greatest number; None where the driver does not state them.
        step: numbers are `low` plus a multiple of it; None for any.
        entries: texts of a menu.
        value: now; None where it can't be read.
    """

    name: str
    kind: Literal["integer", "float", "boolean", "menu", "text", "button"]
    low: float | None = None
    high: float | None = None
    step: float | None = None
    entries: tuple[str, ...] = ()
    value: ControlValue | None = None


def check_controls(wanted: Mapping[str, ControlValue], offered: Mapping[str, Control], camera: str) -> None:
    """Raise ConfigError where a camera does not offer a control or does not take its value.

    Args:
        wanted: values by name.
        offered: the camera's controls by name.
        camera: its name in the error.
    """
    for name, value in wanted.items():
        if name not in offered:
            raise ConfigError(f"{camera} has no control '{name}'; {_known(name, offered)}")
        if fault := _fault(offered[name], value):
            raise ConfigError(f"{camera}: {name}={value}: {fault}")


def _known(name: str, offered: Mapping[str, Control]) -> str:
    if not offered:
        return "it offers none"
    similar = most_similar(name, offered)
    hint = f"did you mean {similar}? " if similar else ""
    names = sorted(offered)
    rest = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return f"{hint}known: {', '.join(names[:SHOWN])}{rest}"


def _fault(control: Control, value: ControlValue) -> str:
    """What is wrong with a value; empty if nothing is."""
    if control.kind == "button" or control.kind == "text":
        return ""
    if control.kind == "menu" and isinstance(value, str):
        return "" if value in control.entries else f"give one of {', '.join(control.entries)}"
    if isinstance(value, str):
        return f"give a {'number' if control.kind != 'boolean' else 'truth value, true or false'}"
    return _fault_of_number(control, value)


def _fault_of_number(control: Control, value: float) -> str:
    if control.kind == "integer" and value != int(value):
        return "give a whole number"
    low = -float("inf") if control.low is None else control.low
    high = float("inf") if control.high is None else control.high
    if not low <= value <= high:
        return f"give a number from {low:g} to {high:g}"
    if control.kind == "integer" and control.step and (value - low) % control.step:
        return f"give {low:g} plus a multiple of {control.step:g}"
    return ""


class Mode(msgspec.Struct, frozen=True):
    """A format of a camera's images.

    Attributes:
        width, height: pixels.
        pixels: the pixel format, as the driver calls it.
        max_fps: the greatest frame rate; None where unknown.
    """

    width: int
    height: int
    pixels: str
    max_fps: float | None = None


class CameraDescription(msgspec.Struct, frozen=True):
    """A camera.

    Attributes:
        driver: v4l2, genicam or picamera.
        source: what `--source` takes to open it.
        name: its model.
        serial: its serial number; empty without one.
        modes, controls: empty where unknown.
        note: why it can't be used now, or else.
    """

    driver: str
    source: str
    name: str
    serial: str = ""
    modes: tuple[Mode, ...] = ()
    controls: tuple[Control, ...] = ()
    note: str = ""
