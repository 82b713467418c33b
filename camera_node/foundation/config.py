# SPDX-License-Identifier: BSD-3-Clause
"""Reads YAML files into msgspec Structs with errors that name the place of a fault, and writes files atomically.

A file is read in bounded time and memory: PyYAML and libyaml recurse, and expand aliases without a limit.
"""

import contextlib
import csv
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
import yaml

from camera_node.foundation.errors import ConfigError, most_similar, printable, unwritable

T = TypeVar("T")
NAME = re.compile(r"(?!\.+$)[A-Za-z0-9_.-]{1,64}")
NAME_RULE = "use letters, digits, _, . and -, at most 64 characters"
KINDS = {  # what a file describes, by a key that no file of another kind has at its top
    "robots": "robots (robots.yaml)",
    "cameras": "cameras (rig.yaml)",
    "markers": "one body of roundels (wand.yaml, an L-frame)",
    "listen": "a server (arena.yaml)",
}
MAX_BYTES = 1 << 20  # of a file; 64 cameras with covariances take a tenth of it
MAX_ARGUMENTS = 1000  # of an action that takes many
MAX_DEPTH = 32  # nested lists and mappings; no file of this project has more than 6
MAX_VALUES = 100_000  # about 1 kB of memory each while a file is read
# libyaml reads ahead of its events by at most 1024 characters of a line, and refuses 1000 levels: that many brackets in
# 1024 characters have a run of 40.
DEEP_RUN = re.compile(rb"[\[{]{%d}" % (MAX_DEPTH + 1))
OPENCV_SYNTAX = re.compile(rb"\A%YAML:1\.0[^\n]*\n|!!opencv-(?:nd-)?matrix")
FOREIGN_END = re.compile(rb"\n---\s*\Z")  # after a message that ROS prints
_Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def example_file(name: str) -> Path:
    """An example of `configs/`, such as `wand.yaml`; see `shipped_path`."""
    return shipped_path(f"configs/{name}")


def shipped_path(name: str) -> Path:
    """A file or folder of `configs/` or `examples/`: the checkout's, or the one that the package contains.

    Raises:
        ConfigError: there is neither.
    """
    package = Path(__file__).resolve().parents[1]
    for root in (package.parent, package):
        if (path := root / name).exists():
            return path
    raise ConfigError(f"{name} is not installed; reinstall the package, or give a file of your own")


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


def require_port(port: int, usual: int) -> None:
    """Raise ConfigError unless --port has a port of TCP or UDP; `usual` is an example."""
    if not 0 <= port < 1 << 16:
        raise ConfigError(f"--port {port} is not a port; give one from 1 to 65535, such as {usual}")


def require_arguments(command: str, action: str, arguments: Sequence[str], use: str) -> None:
    """Raise ConfigError unless an action has as many words as its use, such as `OLD NEW`, `NAME [FILE]`, `FILE...`."""
    words = use.split()
    least = sum(not word.startswith("[") for word in words)
    most = MAX_ARGUMENTS if use.endswith("...") else len(words)
    if not least <= len(arguments) <= most:
        count = f"words after {action}: {len(arguments)}"
        raise ConfigError(f"{count}; use roundel {command} {action} {use}".rstrip())


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
        raise ConfigError(
            _another_kind(path, data, kind) or f"{path}: {fault}{_suggest(kind, fault)}"
        ) from None


def _another_kind(path: Path, data: Any, kind: type) -> str:
    """What a file describes and what it should; empty unless no name at its top is one of a file of this kind."""
    fields = _fields(msgspec.inspect.type_info(kind), [])
    if not isinstance(data, dict) or data.keys() & set(fields):
        return ""
    described = next((about for key, about in KINDS.items() if key in data), "")
    return described and f"{path} describes {described}; give a file with {', '.join(fields)}"


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
    """For an unknown field: the known field with the most similar name, or all known fields. For a text in place of a
    number, such as 9 cm, or a number in place of a list: how to write it. Empty for other faults."""
    if re.match("Expected `(int|float)[^`]*`, got `str`", fault):
        return "; give a number such as 0.12, without a comma, quotes and a unit"
    if re.match("Expected `object[^`]*`, got `array`", fault):
        return "; give names there, each with a colon and without a dash before it"
    if re.match("Expected `array[^`]*`, got `(int|float)`", fault):
        return "; give a list there, such as [[x, y, z]] for one marker"
    given = re.match(r"Expected `str[^`]*`, got `object` - at `\$\.(\w+)`", fault)
    if given and given[1] in KINDS:
        return f"; {KINDS[given[1]]} have a file of their own: give its path there"
    match = re.fullmatch(r"Object contains unknown field `([^`]*)`(?: - at `\$(.*)`)?", fault)
    path = re.sub(r"\[\d+\]", "", match[2] or "") if match else ""
    known = _fields(msgspec.inspect.type_info(kind), path.split(".")[1:]) if match else []
    if not match or not known:
        return ""
    similar = most_similar(match[1], known)
    return f"; did you mean `{similar}`?" if similar else f"; known fields: {', '.join(known)}"


def _fields(info: msgspec.inspect.Type, steps: list[str]) -> list[str]:
    """Names of the fields of the struct at a path of field names inside a type; an entry of a list has no step."""
    if isinstance(info, msgspec.inspect.UnionType):
        return [name for kind in info.types for name in _fields(kind, steps)]
    if isinstance(info, msgspec.inspect.DictType):
        return _fields(info.value_type, steps[1:])
    if isinstance(info, (msgspec.inspect.ListType, msgspec.inspect.VarTupleType)):
        return _fields(info.item_type, steps)
    if not isinstance(info, msgspec.inspect.StructType):
        return []
    if not steps:
        return [field.encode_name for field in info.fields]
    return [name for f in info.fields if f.encode_name == steps[0] for name in _fields(f.type, steps[1:])]


def dump_yaml(data: msgspec.Struct) -> str:
    """Encode a struct as YAML, with short lists on one line; structs with `omit_defaults` omit default values."""
    plain = msgspec.to_builtins(data, enc_hook=_without_numpy)
    return yaml.dump(plain, Dumper=_Dumper, sort_keys=False, width=110, allow_unicode=True)


def _without_numpy(value: Any) -> Any:
    """NumPy's numbers and arrays, of which programs of users make cameras and robots, as Python's."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise NotImplementedError


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file so that a reader sees either the old content or the new one; text is encoded in UTF-8.

    What a symbolic link points to is written, with the permissions of the older file.

    Raises:
        ConfigError: the folder does not exist or is not writable.
    """
    path = Path(os.path.realpath(path))
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(content.encode() if isinstance(content, str) else content)
                file.flush()
                os.fsync(file.fileno())
            os.chmod(name, path.stat().st_mode & 0o777 if path.exists() else 0o644)
            os.replace(name, path)
        except BaseException:
            with contextlib.suppress(OSError):  # what went wrong first is to be reported
                os.unlink(name)
            raise
    except OSError as error:
        raise unwritable(path, error) from None


@contextlib.contextmanager
def hidden_folder(path: Path, own: Collection[str] = ()) -> Iterator[Path]:
    """An empty folder beside `path`, for what is moved to `path` once it is complete; it is removed at the end.

    Args:
        path: a file, or a folder that does not exist or has only files with the names `own`, an older result.
        own: of the files of a result that is a folder.

    Raises:
        ConfigError: `path` is another folder, it can't be written, or the disk is full.
    """
    if path.is_dir() and not (own and path.name and {file.name for file in path.iterdir()} <= {*own}):
        raise ConfigError(f"{path} is a folder with other files; give the name of a new file")
    folder = path.with_name(f".{path.name}.part")
    try:
        shutil.rmtree(folder, ignore_errors=True)  # of a program that was killed
        folder.mkdir()
        yield folder
    except OSError as error:
        raise unwritable(path, error) from None
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def new_path(path: Path, own: Collection[str] = ()) -> Iterator[Path]:
    """Where to write a file or folder that appears at `path` complete at the end, or not at all after an error.

    `path`, `own` and what is raised: as in `hidden_folder`.
    """
    with hidden_folder(path, own) as folder:
        yield folder / path.name
        for name in own:
            (path / name).unlink(missing_ok=True)
        os.replace(folder / path.name, path)


def write_table(path: Path, columns: str, rows: Iterable[Iterable[object]]) -> None:
    """Write a CSV with these columns, separated by commas, as `new_path` does. Raises ConfigError as that does."""
    with new_path(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns.split(","))
        writer.writerows(rows)


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
    return parse_yaml(_read_bounded(path), path, foreign)


def parse_yaml(text: bytes, path: Path, foreign: bool = False) -> Any:
    """The content of a YAML text that was read from a file; see `read_yaml`."""
    if foreign:
        text = FOREIGN_END.sub(b"\n", OPENCV_SYNTAX.sub(b"", text))
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
        # What YAML says of a tab does not name it.
        tabs = [str(k) for k, line in enumerate(text.splitlines(), 1) if b"\t" in line[: -len(line.lstrip())]]
        advice = f"; indent line {tabs[0]} with spaces in place of a tab" if tabs else ""
        raise ConfigError(f"{path} is not valid YAML: {where}{advice}") from None


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
