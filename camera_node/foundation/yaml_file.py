# SPDX-License-Identifier: BSD-3-Clause
"""Reads a YAML file in bounded time and memory: PyYAML and libyaml recurse, and expand aliases without a limit."""

import os
import re
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from camera_node.foundation.errors import ConfigError

MAX_BYTES = 1 << 20  # 64 cameras with covariances take a tenth of it
MAX_DEPTH = 32  # nested lists and mappings; no file of this project has more than 6
MAX_VALUES = 100_000  # about 1 kB of memory each while a file is read
# libyaml reads ahead of its events by at most 1024 characters of a line, and refuses 1000 levels: that many brackets in
# 1024 characters have a run of 40.
DEEP_RUN = re.compile(rb"[\[{]{%d}" % (MAX_DEPTH + 1))
OPENCV_SYNTAX = re.compile(rb"\A%YAML:1\.0[^\n]*\n|!!opencv-matrix")
_Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def read_yaml(path: Path, foreign: bool = False) -> Any:
    """The content of a YAML file: mappings, lists, texts, numbers, dates, booleans and None.

    Args:
        path: the file.
        foreign: accept what OpenCV writes: the line `%YAML:1.0`, which YAML does not allow, and the tag
            `!!opencv-matrix`.

    Raises:
        ConfigError: the file is missing, not a regular file, too large, or not YAML; or it uses tags, or has a key
            twice. Aliases may be used; their values count each time.
    """
    text = _read_bounded(path)
    if foreign:
        text = OPENCV_SYNTAX.sub(b"", text)
    try:
        _require_bounded(text)
        loader = _Loader(text)
        node = loader.get_single_node()
        _require_unique_keys(node)
        return None if node is None else loader.construct_document(node)
    except (
        yaml.YAMLError,
        ValueError,
        ArithmeticError,
    ) as error:  # the last two of impossible dates and numbers
        where = " ".join(str(error).replace('in "<byte string>", ', "at ").split())
        raise ConfigError(f"{path} is not valid YAML: {where}") from None


def _read_bounded(path: Path) -> bytes:
    """The bytes of a regular file. Opening a pipe would wait for its writer without O_NONBLOCK."""
    try:
        with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise ConfigError(f"{path} is not a regular file; give a YAML file")
            data = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise ConfigError(f"{path} does not exist; check the path") from None
    except IsADirectoryError:
        raise ConfigError(f"{path} is not a regular file; give a YAML file") from None
    except (OSError, ValueError) as error:  # ValueError: the path has a null character
        reason = getattr(error, "strerror", None) or error
        raise ConfigError(f"{path} can't be read: {reason}; give a readable file") from None
    if len(data) > MAX_BYTES:
        raise ConfigError(f"{path} has more than {MAX_BYTES} bytes; is it the right file?")
    return data


@dataclass(slots=True)
class _Extent:
    """A list or mapping that is being read, or one that has an anchor: its values and levels, aliases expanded."""

    anchor: str | None
    n_values: int = 1
    n_levels: int = 1


def _require_bounded(text: bytes) -> None:
    """Raise YAMLError for tags, and for too many levels or values, aliases expanded. The parser does not recurse."""
    if deep := DEEP_RUN.search(text):
        raise _excess(f"{MAX_DEPTH} levels", text.count(b"\n", 0, deep.start()) + 1)
    open_extents, anchored = [_Extent(None)], dict[str, _Extent]()
    for event in yaml.parse(text, _Loader):
        line = event.start_mark.line + 1
        if getattr(event, "tag", None) is not None:
            raise yaml.YAMLError(f"line {line} has the tag {event.tag}; write the value without it")
        if isinstance(event, yaml.CollectionStartEvent):
            open_extents.append(_Extent(event.anchor))
        elif isinstance(event, yaml.AliasEvent) and event.anchor not in anchored:
            raise yaml.YAMLError(f"line {line} has the alias *{event.anchor} inside itself, or of no anchor")
        elif isinstance(event, (yaml.CollectionEndEvent, yaml.AliasEvent, yaml.ScalarEvent)):
            _add(_extent_of(event, open_extents, anchored), open_extents[-1])
        depth = len(open_extents) - 1 + open_extents[-1].n_levels - 1
        n_values = sum(extent.n_values for extent in open_extents)
        if depth > MAX_DEPTH or n_values > MAX_VALUES:
            fault = f"{MAX_DEPTH} levels" if depth > MAX_DEPTH else f"{MAX_VALUES} values"
            raise _excess(fault, line)


def _excess(fault: str, line: int) -> yaml.YAMLError:
    return yaml.YAMLError(f"more than {fault} at line {line}; is it the right file?")


def _extent_of(event: yaml.Event, open_extents: list[_Extent], anchored: dict[str, _Extent]) -> _Extent:
    """The extent of the value that ends with an event; one with an anchor is stored."""
    if isinstance(event, yaml.AliasEvent):
        return anchored[event.anchor]
    is_scalar = isinstance(event, yaml.ScalarEvent)
    extent = _Extent(event.anchor, n_levels=0) if is_scalar else open_extents.pop()
    if extent.anchor is not None:
        anchored[extent.anchor] = extent
    return extent


def _add(part: _Extent, whole: _Extent) -> None:
    whole.n_values += part.n_values
    whole.n_levels = max(whole.n_levels, part.n_levels + 1)


def _require_unique_keys(node: yaml.Node | None) -> None:
    """Raise YAMLError where a mapping has a key twice; PyYAML would silently use the last one."""
    if isinstance(node, yaml.MappingNode):
        lines: dict[str, int] = {}
        for key, value in node.value:
            name, line = str(key.value), key.start_mark.line + 1
            if name in lines:
                raise yaml.YAMLError(
                    f"'{name}' is defined twice, in lines {lines[name]} and {line}; remove one"
                )
            lines[name] = line
            _require_unique_keys(value)
    elif isinstance(node, yaml.SequenceNode):
        for value in node.value:
            _require_unique_keys(value)
