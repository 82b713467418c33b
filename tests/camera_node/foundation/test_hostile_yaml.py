# SPDX-License-Identifier: BSD-3-Clause
"""A hostile YAML file costs one line, exit code 2, and little time and memory; each is read by a new process."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from camera_node.foundation.config import MAX_BYTES, MAX_DEPTH, MAX_VALUES
from tests.waiting import DEADLINE_S

READ = """
import resource, sys
from pathlib import Path
from camera_node.foundation.config import load_yaml
from camera_node.foundation.program import run
from camera_node.geometry.body import Body
resource.setrlimit(resource.RLIMIT_AS, (1 << 31, 1 << 31))
run(lambda: print(load_yaml(Path(sys.argv[1]), Body)))
"""

BOMB = "a0: &a0 [x,x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"a{k}: &a{k} [{','.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 9)
)
DEEP = f"more than {MAX_DEPTH} levels"
TEXTS = {
    "brackets": ("[" * 50_000, DEEP),
    "brackets after a value": ("a: [0,\n" + "[{" * 500, DEEP),
    "brackets and other characters": ("[" * 25 + ("[a," + "[" * 31) * 100, DEEP),
    "blocks": ("\n".join(" " * k + "a:" for k in range(1100)), DEEP),
    "dashes": ("- " * 3000, DEEP),
    "question marks": ("? " * 3000, DEEP),
    "alias bomb": (BOMB, f"{MAX_VALUES} values"),
    "recursive alias": ("diameter_m: 0.1\nmarkers: &m [*m]", "inside itself"),
    "alias of no anchor": ("diameter_m: *d", "no anchor"),
    "alias that doubles the depth": (f"a: &a {'[' * 20}{']' * 20}\nb: {'[' * 20}*a{']' * 20}", DEEP),
    "large": ("# " + "x" * MAX_BYTES, f"{MAX_BYTES} bytes"),
    "many values": ("markers: [" + "0," * MAX_VALUES + "]", f"{MAX_VALUES} values"),
    "tag": ('diameter_m: !!int ""', "tag"),
    "digits": ("diameter_m: " + "9" * 5000, "not valid YAML"),
    "date": ("diameter_m: 2001-99-99", "not valid YAML"),
    "binary digits": ("diameter_m: 0b_", "not valid YAML"),
    "control characters in a name": ('"a\\nb\\e[31m": 1', r"a\nb\x1b[31m"),
    "long name": ("diameter_m: 0.1\n" + "? " + "k" * 100_000 + "\n: 1", "body.yaml: "),
}


def read(path: Path) -> subprocess.CompletedProcess[str]:
    """Read a file in a process with 2 GiB of addresses."""
    return subprocess.run(
        [sys.executable, "-c", READ, str(path)], capture_output=True, text=True, timeout=DEADLINE_S
    )


def assert_refused(path: Path, reason: str) -> None:
    done = read(path)
    assert done.returncode == 2, (done.returncode, done.stderr[-500:])
    assert done.stderr.count("\n") == 1
    assert len(done.stderr) < 1000
    assert reason in done.stderr


@pytest.mark.parametrize("name", TEXTS)
def test_a_hostile_text_is_refused_in_one_line(name: str, tmp_path: Path):
    text, reason = TEXTS[name]
    path = tmp_path / "body.yaml"
    path.write_text(text)
    assert_refused(path, reason)


def test_an_alias_stands_for_its_value(tmp_path: Path):
    path = tmp_path / "body.yaml"
    path.write_text("diameter_m: 0.1\nmarkers: [&origin [0, 0, 0], [0.3, 0, 0], [0, &wide 0.3, *wide]]")
    done = read(path)
    assert "(0.0, 0.3, 0.3)" in done.stdout, done.stderr


def test_a_pipe_a_device_and_a_folder_are_refused_at_once(tmp_path: Path):
    """Opening a pipe waits for its writer, and /dev/zero has no end."""
    pipe = tmp_path / "pipe.yaml"
    os.mkfifo(pipe)
    for path in (pipe, Path("/dev/zero"), tmp_path):
        assert_refused(path, "not a regular file")


def test_what_is_just_within_the_limits_is_read(tmp_path: Path):
    path = tmp_path / "body.yaml"
    path.write_text("diameter_m: 0.1\nmarkers: " + "[" * MAX_DEPTH + "]" * MAX_DEPTH)
    assert DEEP in read(path).stderr
    path.write_text("diameter_m: 0.1\nmarkers: [[0, 0, 0]]\n# " + "x" * (MAX_BYTES - 100))
    assert "diameter_m=0.1" in read(path).stdout
