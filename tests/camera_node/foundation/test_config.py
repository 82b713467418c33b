# SPDX-License-Identifier: BSD-3-Clause
"""YAML files: an error names the file and the place in it."""

import errno
import os
import stat
from pathlib import Path

import msgspec
import pytest

from camera_node.foundation.config import load_yaml, write_atomically
from camera_node.foundation.errors import ConfigError, describe_failed_write
from camera_node.geometry.body import Body


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("diameter_m: wide", r"wand.yaml: .*diameter_m"),
        ("diameter_m: 0.1\ncolour: red", "colour"),
        ("diameter_m: 0.1\nmarkers: [[0, 0]]", r"markers\[0\]"),
        ("diameter_m: -1", "diameter"),
        ("diameter_m: 0.1\nmarker: [[0, 0, 0]]", "did you mean `markers`"),
        ("diameter_m: 0.1\nzzz: 1", "diameter_m, markers, normals, inner_ratio, surround_ratio"),
        ("{}", "diameter_m"),
        ("[1, 2", "not valid YAML"),
        ("diameter_m: 1\ndiameter_m: 2", "'diameter_m' .*twice, in lines 1 and 2"),
        ("", "wand.yaml: "),
        ("a: \xff\x00", "YAML"),
        ("diameter_m: 1\nmarkers: [[.nan, 0, 0]]", "within 10 m"),
    ],
)
def test_an_error_names_the_file_and_the_place(tmp_path: Path, text: str, says: str):
    path = tmp_path / "wand.yaml"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(ConfigError, match=says) as caught:
        load_yaml(path, Body)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"none\.yaml does not exist"):
        load_yaml(tmp_path / "none.yaml", Body)
    with pytest.raises(ConfigError, match="not a regular file"):
        load_yaml(tmp_path, Body)


def test_writing_replaces_the_file_and_leaves_no_other_file(tmp_path: Path):
    path = tmp_path / "rig.yaml"
    write_atomically(path, "old " * 1000)
    write_atomically(path, "new: ä\n")
    assert path.read_text(encoding="utf-8") == "new: ä\n"
    assert list(tmp_path.iterdir()) == [path]
    assert stat.S_IMODE(path.stat().st_mode) == 0o644


def test_writing_keeps_a_symbolic_link_and_permissions(tmp_path: Path):
    """Configurations that are kept in a repository are linked to; those with secrets are their owner's."""
    (tmp_path / "kept").mkdir()
    path, link = tmp_path / "kept" / "rig.yaml", tmp_path / "rig.yaml"
    path.write_text("old")
    path.chmod(0o600)
    link.symlink_to(path)
    write_atomically(link, "new")
    assert link.is_symlink()
    assert path.read_text() == "new"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert list(path.parent.iterdir()) == [path]


def test_writing_into_a_missing_folder_is_refused(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"rig\.yaml can't be written"):
        write_atomically(tmp_path / "no" / "rig.yaml", "")


def test_an_error_names_the_entry_of_a_mapping(tmp_path: Path):
    """In a file with several entries, the one with the fault."""
    path = tmp_path / "scene.yaml"
    good, bad = "{diameter_m: 0.1}", "{diameter: 0.1}"
    path.write_text(f"robots: {{a: {good}, b: {bad}, c: {good}}}")
    with pytest.raises(ConfigError, match=r"robots\.b\b.*; did you mean `diameter_m`"):
        load_yaml(path, _Robots)


class _Bodies(msgspec.Struct, forbid_unknown_fields=True):
    bodies: tuple[Body, ...]


def test_a_similar_name_is_proposed_in_an_entry_of_a_list(tmp_path: Path):
    """As of a zone in arena.yaml."""
    path = tmp_path / "bodies.yaml"
    path.write_text("bodies: [{diameter_m: 0.1}, {diameter: 0.1}]")
    with pytest.raises(ConfigError, match=r"bodies\[1\].*; did you mean `diameter_m`"):
        load_yaml(path, _Bodies)


class _Robots(msgspec.Struct):
    robots: dict[str, Body]


@pytest.mark.parametrize(
    ("number", "says"),
    [
        (errno.ENOSPC, "the disk is full: free some space"),
        (errno.EDQUOT, "the disk is full: free some space"),
        (errno.EACCES, "make its folder writable"),
        (errno.ENOENT, "does its folder exist?"),
    ],
)
def test_a_failed_write_says_what_happened(number: int, says: str):
    text = describe_failed_write(OSError(number, os.strerror(number)))
    assert text.startswith(os.strerror(number))
    assert says in text
