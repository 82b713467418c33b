# SPDX-License-Identifier: BSD-3-Clause
"""Reads YAML files into msgspec Structs with errors that name the place of a fault, and writes files atomically."""

import difflib
import os
import re
import tempfile
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
import yaml

from camera_node.foundation.errors import ConfigError
from camera_node.foundation.text import printable
from camera_node.foundation.yaml_file import read_yaml

T = TypeVar("T")
NAME = re.compile(r"(?!\.+$)[A-Za-z0-9_.-]{1,64}")
NAME_RULE = "use letters, digits, _, . and -, at most 64 characters"


def example_file(name: str) -> Path:
    """An example of `configs/`, such as `wand.yaml`: the checkout's, or the one that the package contains.

    Raises:
        ConfigError: there is neither.
    """
    package = Path(__file__).resolve().parents[1]
    for configs in (package.parent / "configs", package / "configs"):
        if (path := configs / name).is_file():
            return path
    raise ConfigError(
        f"the example {name} is not installed; reinstall the package, or give a file of your own"
    )


def is_name(text: str) -> bool:
    """Whether a text can name an arena, a camera or a robot: names are parts of Zenoh keys and of file names."""
    return NAME.fullmatch(text) is not None


def require_name(text: str, what: str) -> str:
    """The text, if it can name `what`, such as "an arena".

    Raises:
        ConfigError: it can't.
    """
    if not is_name(text):
        raise ConfigError(f"'{printable(text, 80)}' can't name {what}; {NAME_RULE}")
    return text


def load_yaml(path: Path, kind: type[T]) -> T:
    """Read a YAML file as `kind`.

    Raises:
        ConfigError: as in `read_yaml`, or the content does not match `kind`; the message names the file and the place
            in it, such as `$.cameras.cam0.fx`.
    """
    data = read_yaml(path)
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        fault = _name_entry(data, kind, str(error))
        raise ConfigError(f"{path}: {fault}{_suggest(kind, fault)}") from None


def _name_entry(data: Any, kind: type, fault: str) -> str:
    """Insert the name of the faulty entry of a mapping, for which msgspec writes `[...]`."""
    mappings = (
        ((key, value) for key, value in data.items() if isinstance(value, dict)) if "[...]" in fault else ()
    )
    for key, entries in mappings:
        for name, entry in entries.items():
            try:
                msgspec.convert({**data, key: {name: entry}}, kind)
            except msgspec.ValidationError as error:
                if f"$.{key}[...]" in str(error):
                    return str(error).replace("[...]", f".{name}", 1)
    return fault


def _suggest(kind: type, fault: str) -> str:
    """For an unknown field: the known field with the most similar name, or all known fields. Empty for other faults."""
    match = re.fullmatch(r"Object contains unknown field `([^`]*)`(?: - at `\$(.*)`)?", fault)
    known = _fields(msgspec.inspect.type_info(kind), (match[2] or "").split(".")[1:]) if match else []
    if not match or not known:
        return ""
    similar = difflib.get_close_matches(match[1], known, 1)
    return f"; did you mean `{similar[0]}`?" if similar else f"; known fields: {', '.join(known)}"


def _fields(info: msgspec.inspect.Type, steps: list[str]) -> list[str]:
    """Names of the fields of the struct at a path of field names inside a type."""
    if isinstance(info, msgspec.inspect.UnionType):
        return [name for kind in info.types for name in _fields(kind, steps)]
    if isinstance(info, msgspec.inspect.DictType):
        return _fields(info.value_type, steps[1:])
    if not isinstance(info, msgspec.inspect.StructType):
        return []
    if not steps:
        return [field.encode_name for field in info.fields]
    return [name for f in info.fields if f.encode_name == steps[0] for name in _fields(f.type, steps[1:])]


def dump_yaml(data: msgspec.Struct) -> str:
    """Encode a struct as YAML, with short lists on one line; structs with `omit_defaults` omit default values."""
    return yaml.dump(
        msgspec.to_builtins(data), Dumper=_Dumper, sort_keys=False, width=110, allow_unicode=True
    )


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file so that a reader sees either the old content or the new one; text is encoded in UTF-8.

    Raises:
        ConfigError: the folder does not exist or is not writable.
    """
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(content.encode() if isinstance(content, str) else content)
                file.flush()
                os.fsync(file.fileno())
            os.chmod(name, 0o644)
            os.replace(name, path)
        except BaseException:
            os.unlink(name)
            raise
    except OSError as error:
        raise ConfigError(f"{path} can't be written: {error.strerror}; does its folder exist?") from None


class _Dumper(yaml.SafeDumper):
    """Writes lists of numbers and texts on one line."""


def _represent_list(dumper: yaml.SafeDumper, data: list | tuple) -> yaml.Node:
    flat = all(isinstance(x, (int, float, str)) for x in data)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=flat)


def _represent_text(dumper: yaml.SafeDumper, data: str) -> yaml.Node:
    """Text with control characters or odd line breaks is read back as it was only from double quotes."""
    return dumper.represent_scalar("tag:yaml.org,2002:str", data, style=None if data.isprintable() else '"')


_Dumper.add_representer(str, _represent_text)
_Dumper.add_representer(list, _represent_list)
_Dumper.add_representer(tuple, _represent_list)
_Dumper.add_representer(np.float64, lambda dumper, x: dumper.represent_float(float(x)))
