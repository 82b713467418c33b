# SPDX-License-Identifier: BSD-3-Clause
"""Files that people write: YAML in, checked against a msgspec Struct; text out, atomically."""

import os
import tempfile
from pathlib import Path
from typing import TypeVar

import msgspec
import yaml

from camera_node.errors import ConfigError

T = TypeVar("T")


def load_yaml(path: Path, kind: type[T]) -> T:
    """Read a YAML file as `kind`.

    Raises:
        ConfigError: the file is missing or unreadable, is no YAML, or does not fit `kind`; the message names
            the file and the place in it, such as `$.cameras.cam0.fx`.
    """
    try:
        return msgspec.yaml.decode(path.read_bytes(), type=kind)
    except FileNotFoundError:
        raise ConfigError(f"{path} does not exist; check the path") from None
    except OSError as error:
        raise ConfigError(f"{path} can't be read: {error.strerror}") from None
    except msgspec.ValidationError as error:
        raise ConfigError(f"{path}: {error}") from None
    except (msgspec.DecodeError, yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from None


def write_atomically(path: Path, text: str) -> None:
    """Write a file so that a reader sees the old text or the new one, never a part.

    Raises:
        ConfigError: the folder does not exist or can't be written to.
    """
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            os.chmod(name, 0o644)
            os.replace(name, path)
        except BaseException:
            os.unlink(name)
            raise
    except OSError as error:
        raise ConfigError(f"{path} can't be written: {error.strerror}; is its folder there?") from None
