# SPDX-License-Identifier: BSD-3-Clause
"""The folders of the native cores form layers: a file includes files of its own folder and of lower layers only."""

import re
from pathlib import Path

import pytest

from tests.conftest import ROOT

CAMERA_NODE, FUSION = ROOT / "camera_node" / "native", ROOT / "fusion" / "native"
LAYERS = (
    ("numeric",),
    ("fit", "lens"),
    ("search", "verify", "code"),
    ("blur", "reference"),
    (".",),
)  # the lowest first
LEVEL = {folder: level for level, folders in enumerate(LAYERS) for folder in folders}


def includes(native: Path) -> list[tuple[Path, Path]]:
    """All pairs of a source file and a file of ours that it includes, both as absolute paths."""
    pairs = []
    for source in sorted(native.rglob("*.[ch]pp")):
        for name in re.findall(r'^#include "(.+)"', source.read_text(), re.MULTILINE):
            places = [folder / name for folder in (source.parent, native, CAMERA_NODE)]
            pairs.append((source, next((p for p in places if p.exists()), places[0]).resolve()))
    return pairs


def folder_of(path: Path) -> str:
    return str(path.parent.relative_to(CAMERA_NODE))


def is_allowed(source: Path, included: Path) -> bool:
    own, other = folder_of(source), folder_of(included)
    return own == other or LEVEL[other] < LEVEL[own]


def test_every_folder_has_a_layer():
    folders = {folder_of(path) for path in CAMERA_NODE.rglob("*.[ch]pp")}
    assert folders == set(LEVEL)


@pytest.mark.parametrize("native", [CAMERA_NODE, FUSION], ids=["camera_node", "fusion"])
def test_every_include_names_a_file(native: Path):
    pairs = includes(native)
    assert pairs
    assert [pair for pair in pairs if not pair[1].is_file()] == []


def test_no_file_includes_a_higher_or_another_folder_of_its_layer():
    upward = [
        f"{source.relative_to(ROOT)} includes {included.relative_to(ROOT)}"
        for source, included in includes(CAMERA_NODE)
        if not is_allowed(source, included)
    ]
    assert upward == []


def test_an_upward_and_a_sideways_include_are_refused():
    fit, search, verify = (CAMERA_NODE / folder / "a.hpp" for folder in ("fit", "search", "verify"))
    assert is_allowed(search, fit)
    assert not is_allowed(fit, search)
    assert not is_allowed(search, verify)


def test_fusion_includes_only_numerics_of_the_camera_node():
    others = [
        f"{source.relative_to(ROOT)} includes {included.relative_to(ROOT)}"
        for source, included in includes(FUSION)
        if FUSION not in included.parents and CAMERA_NODE / "numeric" not in included.parents
    ]
    assert others == []
