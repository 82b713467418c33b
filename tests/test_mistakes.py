# SPDX-License-Identifier: BSD-3-Clause
"""docs/mistakes.md is true: each mistake is made, and its answer is the one in the table, word by word."""

import contextlib
import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path

import cv2
import pytest

from camera_node.foundation.errors import RoundelError, printable
from camera_node.sources.recorded_frames import read_grey
from tests.conftest import ROOT, free_port
from tests.fusion.serving import config, serving
from web.roundel.command import execute

ROW = re.compile(  # an answer with backticks stands between two of them
    r"^\| (?P<mistake>[^|]+) \| `(?P<command>[^`]+)` \| (?P<tick>``?) ?(?P<answer>.+?) ?(?P=tick) \|$",
    re.MULTILINE,
)
SECTIONS = re.split(r"^## (.*)$", (ROOT / "docs" / "mistakes.md").read_text(), flags=re.MULTILINE)[1:]
TABLE = [
    pytest.param(section, *row.group("mistake", "command", "answer"), id=f"{section}: {row['mistake']}")
    for section, text in zip(SECTIONS[::2], SECTIONS[1::2], strict=True)
    for row in ROW.finditer(text)
]
LIVE = [row for row in TABLE if row.values[0] == "A running arena"]
OFFLINE = [row for row in TABLE if row not in LIVE]
CORNERS = "[[0.2, 0, 0], [-0.16, 0.09, 0], [-0.1, -0.1, 0]]"
FILES = {
    "notes.txt": "notes",
    "text.mcap": "notes",
    "empty.mcap": "",
    "broken.yaml": "cameras: [",
    "other.csv": "time,name,x,y\n1,north,2,3\n",
    "lengths.yaml": "diameter_m: 0.12\nmarkers: [[-0.25, 0, 0], [0.0, 0, 0], [0.25, 0, 0]]\n",
    "mm_wand.yaml": "diameter_m: 120\nmarkers: [[-250, 0, 0], [-50, 0, 0], [250, 0, 0]]\n",
    "none.yaml": "robots: {}\n",
    "mm_robot.yaml": "robots:\n  a: {diameter_m: 120, markers: [[200, 0, 0], [-160, 90, 0], [-100, -100, 0]]}\n",
    "misspelt.yaml": f"robots:\n  a: {{diameter: 0.12, markers: {CORNERS}}}\n",
    "sizes.yaml": f"robots:\n  rover: {{diameter_m: 0.09, markers: {CORNERS}}}\n",
    "twins.yaml": "robots:\n" + "".join(f"  {n}: {{diameter_m: 0.12, markers: {CORNERS}}}\n" for n in "ab"),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data of `roundel sample`, and files with a mistake."""
    path = tmp_path_factory.mktemp("mistakes")
    with contextlib.chdir(path):
        execute("sample")
    for name, text in FILES.items():
        (path / name).write_text(text)
    first = min((path / "sample/frames/north").iterdir())
    image = read_grey(first)
    for inner in ("small/north", "named/north", "few/north", "emptydir"):
        (path / inner).mkdir(parents=True)
    cv2.imwrite(str(path / "small/north" / first.name), image[::2, ::2])
    shutil.copy(first, path / "named/north/frame_1.png")
    shutil.copy(first, path / "few/north" / first.name)
    shutil.copytree(path / "sample/frames", path / "nested/all")
    return path


def answer_to(command: str, capsys: pytest.CaptureFixture[str], *options: str) -> str:
    """What a command prints, or the line of its error."""
    try:
        execute(*shlex.split(command)[1:], *options)
    except RoundelError as error:
        return printable(error)
    return capsys.readouterr().out


def matches(expected: str, answer: str) -> bool:
    """Whether an answer has a line of the table, in which `...` stands for what differs between machines."""
    pattern = ".*".join(map(re.escape, expected.split("...")))
    return any(re.fullmatch(pattern, line) for line in answer.splitlines())


@pytest.mark.parametrize(("section", "mistake", "command", "expected"), OFFLINE)
def test_the_answer_to_a_mistake(
    section: str,
    mistake: str,
    command: str,
    expected: str,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.chdir(folder)
    address = f"tcp/127.0.0.1:{free_port()}"
    options = ("--connect", address) if mistake == "no server" else ()
    answer = answer_to(command, capsys, *options).replace(address, "tcp/127.0.0.1:7447")
    assert matches(expected, answer), f"{command}\nsaid     {answer}\nexpected {expected}"


@pytest.fixture(scope="module")
def endpoints(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, ...]]:
    """A running server of the arena `test`, with the robot a."""
    with serving(config(tmp_path_factory.mktemp("server"))) as (server, _):
        yield server.endpoints


@pytest.mark.parametrize(("section", "mistake", "command", "expected"), LIVE)
def test_the_answer_to_a_mistake_in_a_running_arena(
    section: str,
    mistake: str,
    command: str,
    expected: str,
    endpoints: tuple[str, ...],
    capsys: pytest.CaptureFixture[str],
):
    arena = () if "--arena" in command else ("--arena", "test")
    answer = answer_to(command, capsys, "--connect", *endpoints, *arena)
    assert matches(expected, answer), f"{command}\nsaid     {answer}\nexpected {expected}"


def test_each_row_of_the_page_is_tried():
    rows = [line for line in "".join(SECTIONS[1::2]).splitlines() if "`roundel" in line]
    assert len(TABLE) == len(rows) >= 60


REMEDIES = (
    "roundel detect sample/frames/east",
    "roundel detect sample/frames/north --draw seen",
    "roundel print roundels big.pdf --diameter 0.2 --paper a3",
    "roundel print robot rover.pdf",
    "roundel run --frames nested/all --rig sample/rig.yaml --robots sample/robots.yaml --out poses.csv",
    "roundel trim sample/recording.mcap part.mcap --from-s 3 --to-s 4 --force",
    "roundel sample sample2",
    "roundel detect sample/frames/north --rig sample/rig.yaml --name north --diameter 0.12",
    "roundel export sample/recording.mcap rover.csv --robots rover",
)


def test_the_remedies_work(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """What the answers advise, in the folder in which the mistakes were made."""
    monkeypatch.chdir(folder)
    for command in REMEDIES:
        assert execute(*shlex.split(command)[1:]) in (0, None), command
