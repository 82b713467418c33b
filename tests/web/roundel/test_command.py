# SPDX-License-Identifier: BSD-3-Clause
"""The command `roundel`: its commands, their help, and mistakes in the command line."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from web.roundel.command import COMMANDS

MAIN = "from web.roundel.command import main; main()"


def roundel(*words: str, folder: Path | None = None, **env: str) -> subprocess.CompletedProcess[str]:
    """Run the command in a process of its own, which is in no checkout."""
    return subprocess.run(
        [sys.executable, "-P", "-c", MAIN, *words],
        cwd=folder,
        env={**os.environ, **env},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def test_the_list_of_commands_is_complete(tmp_path: Path):
    """Without a command, all of them in the order of the work, each with a summary."""
    text = roundel(folder=tmp_path).stdout
    assert re.findall(r"^  (\w+) +\w", text, re.MULTILINE) == list(COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_help_has_examples(name: str, tmp_path: Path):
    """Each command's help shows its examples, complete and on a line of their own."""
    done = roundel(name, "--help", folder=tmp_path, COLUMNS="100")
    assert done.returncode == 0, done.stderr
    assert f"usage: roundel {name}" in done.stdout
    for example in COMMANDS[name].examples:
        assert f"\n  {example}\n" in done.stdout


@pytest.mark.parametrize(
    ("words", "nearest"),
    [
        (("dmeo",), "demo"),
        (("calibrate", "wandd"), "wand"),
        (("camera", "--suorce", "0"), "--source"),
        (("calibrate", "wand", "--wnad", "x"), "--wand"),
        (("record", "x.mcap", "--second", "3"), "--seconds"),
        (("view", "--demo-mode"), "--demo"),
        (("server", "--listne", "tcp/127.0.0.1:7447"), "--listen"),
    ],
)
@pytest.mark.parametrize("columns", ["60", "200"])
def test_a_typo_is_one_line_with_the_nearest_option(words: tuple[str, ...], nearest: str, columns: str):
    """Exit code 2, whatever the width of the terminal."""
    done = roundel(*words, COLUMNS=columns)
    assert done.returncode == 2
    assert re.fullmatch(r"error: there is no .*; did you mean (\S+)\? \(.*\)\n", done.stderr), done.stderr
    assert f"did you mean {nearest}?" in done.stderr


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("view", "--port", "x"), "--port: 'x' is not a number"),
        (("define", "rover"), "--diameter FLOAT is missing"),
        (("record",), r"PATH \(the MCAP file to write\) is missing"),
        (("detect", "--draw"), "Missing value for argument '--draw'"),
        (("detect", "--detector", "eye", "x.png"), "invalid choice 'eye' for argument '--detector'.*chords"),
        (("camera", "--source", "0", "--name", "a", "extra"), "'extra' was not expected"),
        (("--headless",), "--headless needs a command before it"),
    ],
)
def test_an_invalid_value_is_one_line(words: tuple[str, ...], text: str):
    """Exit code 2; the line names the option and the command that lists all of them."""
    done = roundel(*words)
    assert done.returncode == 2
    assert re.fullmatch(rf"error: .*{text}.*--help.*\n", done.stderr, re.IGNORECASE), done.stderr


def test_a_command_imports_its_own_program_only():
    """A camera's computer has neither GTSAM nor Viser nor MCAP."""
    code = (
        "import sys\n"
        "for name in ('gtsam', 'viser', 'scipy', 'mcap', 'psutil', 'websockets'): sys.modules[name] = None\n"
        + MAIN
    )
    for words in (["camera", "--help"], ["detect", "--help"], ["print", "--help"], ["--help"]):
        done = subprocess.run(
            [sys.executable, "-c", code, *words], capture_output=True, text=True, timeout=60
        )
        assert done.returncode == 0, done.stderr


def test_opencv_writes_no_warning(tmp_path: Path):
    """A broken picture and video are one line each, that of this project."""
    for name, words in (("x.png", ("detect",)), ("x.mp4", ("camera", "--name", "a", "--source"))):
        (tmp_path / name).write_bytes(b"\x89PNG not a picture")
        done = roundel(*words, name, folder=tmp_path)
        assert done.returncode == 2
        assert re.fullmatch(r"error: .*\n", done.stderr), done.stderr
