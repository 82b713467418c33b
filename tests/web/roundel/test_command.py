# SPDX-License-Identifier: BSD-3-Clause
"""The command `roundel`: its commands, their help, and mistakes in the command line."""

import contextlib
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from camera_node.foundation.command_line import Command
from camera_node.foundation.errors import ConfigError
from tests.web.roundel.programs import MAIN, roundel_process
from web.roundel.command import COMMANDS, execute

WORK = ("up", "camera", "print", "calibrate", "define", "record", "ros2")  # in its order


def with_groups(commands: Sequence[Command], before: str = "") -> list[tuple[str, Command]]:
    """The words and the record of each command, also of those in groups."""
    named = [(f"{before}{command.name}", command) for command in commands]
    groups = [with_groups(c.target, f"{words} ") for words, c in named if not isinstance(c.target, str)]
    return named + [entry for group in groups for entry in group]


def mistake(*words: str) -> str:
    """The error of a command line, in this process."""
    with pytest.raises(ConfigError) as error:
        execute(*words)
    assert error.value.exit_code == 2
    assert "\n" not in str(error.value)
    return str(error.value)


def test_the_list_of_commands_is_complete(tmp_path: Path):
    """Without a command, all of them in the order of the work, each with a summary."""
    text = roundel_process(folder=tmp_path).stdout
    listed = re.findall(r"^  (\w+) +\w", text, re.MULTILINE)
    assert sorted(listed) == sorted(command.name for command in COMMANDS)
    assert [name for name in listed if name in WORK] == list(WORK)


@pytest.mark.parametrize(
    ("words", "same"), [("help", "--help"), ("help trim", "trim --help"), ("version", "--version")]
)
def test_help_and_version_are_commands_too(words: str, same: str, capsys: pytest.CaptureFixture[str]):
    """`roundel help` advised `health`, and `roundel version` advised `verify`."""
    said = []
    for line in (words, same):
        with contextlib.suppress(SystemExit):
            assert execute(*line.split()) == 0
        said.append(capsys.readouterr().out)
    assert said[0] == said[1] != ""


@pytest.mark.parametrize(("words", "command"), with_groups(COMMANDS))
def test_help_has_examples(words: str, command: Command, capsys: pytest.CaptureFixture[str]):
    """Each command's help shows its examples, complete and on a line of their own."""
    with contextlib.suppress(SystemExit):
        assert execute(*words.split(), "--help") == 0
    text = capsys.readouterr().out
    assert f"usage: roundel {words}" in text
    assert command.examples
    for example in command.examples:
        assert f"\n  {example}\n" in text


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
def test_a_typo_is_one_line_with_the_nearest_option(
    words: tuple[str, ...], nearest: str, columns: str, monkeypatch: pytest.MonkeyPatch
):
    """Whatever the width of the terminal."""
    monkeypatch.setenv("COLUMNS", columns)
    assert re.fullmatch(rf"there is no .*; did you mean {nearest}\? \(.*--help.*\)", mistake(*words))


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("view", "--port", "x"), "--port: 'x' is not a number"),
        (("define", "rover"), "--diameter FLOAT is missing"),
        (("record",), r"PATH \(the MCAP file to write\) is missing"),
        (("detect", "--draw"), "'--draw'"),
        (("detect", "--detector", "eye", "x.png"), "'eye'.*'--detector'.*chords"),
        (("demo", "extra"), "'extra' was not expected"),
        (("--headless",), "--headless needs a command before it"),
    ],
)
def test_an_invalid_value_is_one_line(words: tuple[str, ...], text: str):
    """The line names the option and the command that lists all of them."""
    assert re.fullmatch(rf".*{text}.*--help.*", mistake(*words), re.IGNORECASE)


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


@pytest.mark.parametrize(
    ("command", "package"), [("up", "websockets"), ("server", "gtsam"), ("replay", "mcap")]
)
def test_a_camera_s_machine_says_what_to_install(command: str, package: str, tmp_path: Path):
    """One line with the extra, where the packages of the server are missing."""
    code = f"import sys; sys.modules[{package!r}] = None\n{MAIN}"
    words = [command, *(["x.mcap"] if command == "replay" else [])]
    done = subprocess.run(
        [sys.executable, "-c", code, *words], cwd=tmp_path, capture_output=True, text=True, timeout=60
    )
    line = f"error: roundel {command} needs {package}, .* pip install 'roundel\\[server\\]'\n"
    assert re.fullmatch(line, done.stderr), done.stderr
    assert done.returncode == 2


def test_opencv_writes_no_warning(tmp_path: Path):
    """A broken picture and a broken video are one line each, that of this project."""
    board = ("--board", "chessboard:4x5:0.05", "--out", "rig.yaml")
    for name, words in (("x.png", ("detect",)), ("x.mp4", ("calibrate", "intrinsics", *board, "--frames"))):
        (tmp_path / name).write_bytes(b"\x89PNG not a picture")
        done = roundel_process(*words, name, folder=tmp_path)
        assert done.returncode == 2
        assert re.fullmatch(r"error: .*\n", done.stderr), done.stderr
