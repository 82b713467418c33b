# SPDX-License-Identifier: BSD-3-Clause
"""Reads surveyed positions of cameras or roundels from CSV and YAML files."""

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from camera_node.foundation.arrays import Array
from camera_node.foundation.config import load_yaml
from camera_node.foundation.errors import ConfigError


def read_positions(path: Path, key: str = "camera") -> dict[str, Array]:
    """Read positions (3,) by name, metres, from a CSV or a YAML file.

    A CSV has the columns `key` (or `name`), x, y, z. A YAML file maps names to [x, y, z].

    Raises:
        ConfigError: the file is missing, a column is missing, a name occurs twice, or a coordinate is not a number.
    """
    if path.suffix.lower() in (".yaml", ".yml"):
        entries = load_yaml(path, dict[str, tuple[float, float, float]])
        return {name: np.array(position) for name, position in entries.items()}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return _read_csv(path, csv.DictReader(file), key)
    except (OSError, UnicodeDecodeError):
        raise ConfigError(f"{path} can't be read; it needs the columns {key},x,y,z") from None


def _read_csv(path: Path, reader: csv.DictReader, key: str) -> dict[str, Array]:
    columns = set(reader.fieldnames or ())
    key = key if key in columns else "name"
    if missing := {key, "x", "y", "z"} - columns:
        raise ConfigError(f"{path} lacks the column {', '.join(sorted(missing))}; it needs {key},x,y,z")
    positions: dict[str, Array] = {}
    for row in reader:
        if row[key] in positions:
            raise ConfigError(f"{path} names '{row[key]}' twice; remove one row")
        positions[row[key]] = _parse_point(row, path, reader.line_num)
    return positions


def _parse_point(row: Mapping[str, str], path: Path, line: int) -> Array:
    try:
        point = np.array([float(row[axis]) for axis in "xyz"])
    except (TypeError, ValueError):
        point = np.full(3, np.nan)
    if not np.isfinite(point).all():
        raise ConfigError(f"{path}, line {line}: x, y and z must be numbers, in metres")
    return point
