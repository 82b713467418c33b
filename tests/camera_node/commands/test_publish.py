# SPDX-License-Identifier: BSD-3-Clause
"""The command line: a mistake of the user is reported as one line with exit code 2."""

from pathlib import Path

import pytest

from tests.processes import run_program

pytestmark = pytest.mark.computed


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--source", "99"], "/dev/video99 does not exist"),
        (["--source", "nowhere"], "no folder, video or camera 'nowhere'"),
        (["--source", "sim"], "cam0"),
        (["--source", "FRAMES", "--name", "a/b"], "'a/b' can't name a camera"),
        (["--source", "FRAMES", "--arena", "*"], "'*' can't name an arena"),
        (["--source", "FRAMES", "--connect", "server"], "tcp/host:7447"),
        (["--source", "FRAMES", "--inner-ratios", "7"], "inner_ratios"),
        (["--source", "FRAMES", "--zenoh", "none.json5"], "none.json5 does not exist"),
        (["detct", "FRAMES"], "did you mean detect?"),
        (["show", "FRAMES"], "detect, print"),
        (["--source", "FRAMES", "--fourcc", "JPEG2000"], "four letters"),
    ],
)
def test_mistakes_are_one_line(tmp_path: Path, arguments: list[str], says: str):
    (tmp_path / "0.png").write_bytes(b"no image")
    arguments = [str(tmp_path) if argument == "FRAMES" else argument for argument in arguments]
    done = run_program("camera_node", *arguments, *([] if "--name" in arguments else ["--name", "cam0"]))
    assert done.returncode == (75 if "99" in arguments else 2)  # a device may be plugged in later
    assert says in done.stderr
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1


def test_help_and_wrong_options():
    assert "--source" in run_program("camera_node", "--help").stdout
    wrong = run_program("camera_node", "--colour", "red")
    assert wrong.returncode == 2
    assert "Traceback" not in wrong.stderr
