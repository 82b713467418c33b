# SPDX-License-Identifier: BSD-3-Clause
"""docs/mistakes.md is true: each mistake is made, and its answer is the one in the table, word by word."""

import contextlib
import re
import shlex
import shutil
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import cv2
import pytest

from calib.rig.recording import read_detections
from calib.rig.rig import Rig, load_rig, save_rig
from camera_node.foundation.arrays import Array
from camera_node.foundation.errors import RoundelError, printable
from camera_node.protocol.messages import encode
from camera_node.protocol.registration import CameraRegistration, register_key
from camera_node.protocol.requests import send_request
from camera_node.sources.recorded_frames import read_grey
from fusion.commands.trim import trim
from tests.calib.boards import SPEC, board_poses, render
from tests.conftest import ROOT, free_port
from tests.fusion.serving import config, serving
from tests.fusion.unknown_robot import serving_an_unknown_robot
from tests.web.roundel.programs import Program, roundel_command
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
    "unit_wand.yaml": "diameter_m: 0.12 cm\nmarkers: [[-0.25, 0, 0], [-0.05, 0, 0], [0.25, 0, 0]]\n",
    "comma_wand.yaml": "diameter_m: 0,12\nmarkers: [[-0.25, 0, 0], [-0.05, 0, 0], [0.25, 0, 0]]\n",
    "list.yaml": "robots:\n- name: rover\n  diameter_m: 0.12\n",
    "none.yaml": "robots: {}\n",
    "tab.yaml": "robots:\n\ta: {diameter_m: 0.12}\n",
    "twice.yaml": "robots:\n  a: {diameter_m: 0.12}\n  a: {diameter_m: 0.12}\n",
    "flat.yaml": "robots:\n  a: {diameter_m: 0.12, markers: [0.0, 0.0, 0.0]}\n",
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
    rig = load_rig(path / "sample/rig.yaml")
    others = Rig(cameras=dict(zip("abcd", rig.cameras.values(), strict=True)))
    save_rig(others, path / "others.yaml")
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


WAND = "--wand sample/wand.yaml --recording sample/wand.mcap"
SOLVE = f"roundel calibrate wand {WAND} --rig sample/lenses.yaml --out new.yaml"
RUN = "roundel run --frames sample/frames --rig sample/rig.yaml --robots sample/robots.yaml --out poses.csv"
REPLAY = "roundel replay sample/recording.mcap --out poses.csv"
LENSES = f"roundel calibrate intrinsics --board {SPEC} --frames boards --out new.yaml"
# What each answer advises: another command, or what replaces a part of the mistaken one. Several lead to one command.
REMEDIES: dict[str, str | tuple[str, str]] = {
    "a misspelt command": ("dtect", "detect"),
    "a misspelt option": ("--inner-ratio", "--inner-ratios"),
    "an action that a command lacks": ("delete", "remove"),
    "an option that is missing": LENSES,
    "no picture": ("detect", "detect sample/frames/north"),
    "a picture that is not there": ("nort.png", "sample/frames/north"),
    "a text file": ("notes.txt", "sample/frames/north"),
    "the folder of all cameras": ("sample/frames", "sample/frames/east"),
    "the folder of the sample": ("sample", "sample/frames/north"),
    "a file for several drawings": ("seen.png", "seen"),
    "a camera that the rig lacks": ("nord", "north"),
    "millimetres in place of metres": ("120", "0.12"),
    "pictures of another size than the rig's": ("small/north", "sample/frames/north"),
    "a print of millimetres": ("90", "0.09"),
    "a roundel larger than the paper": ("0.2", "0.2 --paper a3"),
    "a print without suffix": ("robot rover", "robot rover.pdf"),
    "a paper that is not known": ("a5", "a4"),
    "a robot that the file lacks": ("rovr", "rover"),
    "a wand printed as a robot": ("wand.yaml", "robots.yaml"),
    "the robots as the wand": SOLVE,
    "the wand as the rig": SOLVE,
    "the wand as the robots": RUN,
    "the rig as the robots": ("rig.yaml", "robots.yaml"),
    "a rig as a recording": REPLAY,
    "a text file as a recording": ("text.mcap", "sample/recording.mcap"),
    "an empty file as a recording": REPLAY,
    "a rig as a plan": ("plan", "plan --rig"),
    "a recording as a folder of frames": RUN,
    "a broken YAML file": RUN,
    "a tab in a YAML file": ("tab.yaml", "indented.yaml"),
    "a name twice in a YAML file": ("twice.yaml", "indented.yaml"),
    "a board without the size of a square": LENSES,
    "a square of millimetres": LENSES,
    "pictures without the board": LENSES,
    "neither pictures nor a camera": LENSES,
    "an empty folder": LENSES,
    "no recording": SOLVE,
    "a recording of robots": SOLVE,
    "a wand whose file states other lengths": SOLVE,
    "a wand of millimetres": SOLVE,
    "a comma in a number": SOLVE,
    "a unit behind a number": SOLVE,
    "a misspelt camera": ("nord", "north"),
    "one camera only": SOLVE,
    "a folder that is not there": SOLVE,
    "a CSV with other columns": ("other.csv", "wand.csv"),
    "the floor before the wand": SOLVE,
    "the straight wand as an L-frame": (
        "--frame sample/wand.yaml --frames sample/frames",
        "--standing sample/wand.yaml --observations standing.csv",
    ),
    "undo of a file that is not there": ("rgi.yaml", "versions.yaml"),
    "a rig without poses": SOLVE,
    "millimetres in robots.yaml": RUN,
    "a misspelt field": ("misspelt.yaml", "spelt.yaml"),
    "the coordinates of one marker without its own brackets": ("flat.yaml", "bracketed.yaml"),
    "two robots that look alike": ("twins.yaml", "apart.yaml"),
    "no robot in the file": RUN,
    "roundels of another size than the file says": RUN,
    "frames of another size than the rig's": RUN,
    "pictures that are not named by their time": ("named", "renamed"),
    "a folder too low": RUN,
    "robots as a list": RUN,
    "a folder too high": ("nested", "nested/all"),
    "poses in a format of roundel export": ("poses.parquet", "poses.mcap"),
    "a recording that is not there": REPLAY,
    "the rig of other cameras": ("others.yaml", "sample/rig.yaml"),
    "a wand recording replayed": (
        "wand.mcap",
        "wand.mcap --rig sample/rig.yaml --robots sample/robots.yaml",
    ),
    "the recording as its own result": ("--out sample/recording.mcap", "--out poses.mcap"),
    "a part before the beginning": ("-3", "1"),
    "a part after the end": ("100", "1"),
    "a part that ends before it begins": ("--from-s 3", "--force --from-s 1"),
    "a part over another recording": ("sample/wand.mcap", "part2.mcap"),
    "a format that is not known": ("poses.xlsx", "rover.csv"),
    "a misspelt robot": ("rovr", "rover"),
    "the export of a recording without poses": ("sample/wand.mcap out.csv", "poses.mcap fused.csv"),
    "a sample where there is one": ("sample", "sample sample2"),
}
NODES = "roundel camera --source sample/frames/north sample/frames/east --controls focus_absolute=30"
LIVE_REMEDIES: dict[str, str | tuple[str, str]] = {
    "an address without protocol": ("--connect localhost:7447", ""),
    "a camera that is not there": NODES,
    "a control without a value": NODES,
    "the folder of all cameras as one": NODES,
    "commas between coordinates": "roundel define rover --diameter 0.12 --at -0.4 0.2 0.3",
    "no server": ("--timeout-s 1", ""),
    "a size of millimetres": ("--diameter 90 --at 0 0 0", "--diameter 0.12 --at -0.4 0.2 0.3"),
    "a folder without recordings": "roundel record recorded/today.mcap --seconds 1",
    "a recording without suffix": ("monday", "monday.mcap"),
    "a misspelt camera in a rename": ("nort", "north"),
    "a name that no camera can have": ('north "north door"', "x north_door"),
    "an arena of another name": ("--arena demo --timeout-s 1", ""),
    "a rename without the new name": ("rename x", "rename north_door x"),
    "a turn without the angle": ("turn a", "turn a 90"),
    "a misspelt robot in a removal": ("aa", "a"),
}
# All of them lead to one command.
STARTED = (
    "text where a number belongs",
    "a name with a space",
    "a port that there is not",
    "an address that is a port only",
    "a server's address that is a port only",
    "a bridge at a port that there is not",
    "a server without a file of robots",
    "the robots as the settings of a server",
)
WITHOUT_ADVICE = ("nothing to undo", "undo without a change")


def remedied(mistake: str, command: str, remedy: str | tuple[str, str]) -> str:
    """The command after the answer to a mistake was followed."""
    if isinstance(remedy, str):
        return remedy
    assert remedy[0] in command, mistake
    return command.replace(remedy[0], remedy[1], 1)


def followed(remedies: Mapping[str, str | tuple[str, str]]) -> dict[str, list[str]]:
    """The mistakes by the command to which their answers lead."""
    commands: dict[str, list[str]] = {}
    for row in TABLE:
        _, mistake, command, _ = map(str, row.values)
        if mistake in remedies:
            commands.setdefault(remedied(mistake, command, remedies[mistake]), []).append(mistake)
    return commands


def test_the_remedy_of_each_mistake_is_known():
    """Each is executed below, but where an answer says that nothing was changed and there is nothing to do."""
    answers = {str(row.values[1]): str(row.values[3]) for row in TABLE}
    assert sorted([*REMEDIES, *LIVE_REMEDIES, *STARTED, *WITHOUT_ADVICE]) == sorted(answers)
    assert all(answers[mistake].endswith("nothing was changed") for mistake in WITHOUT_ADVICE)


def write_centres(path: Path, frames: Iterable[tuple[int, str, Array]]) -> None:
    """Write the centres (N, 2) of the time (ns) and camera of each frame as a CSV of observations."""
    with path.open("w") as file:
        print("t_ns,camera,u,v", file=file)
        for t_ns, camera, uv in frames:
            for u, v in uv:
                print(f"{t_ns},{camera},{u},{v}", file=file)


@pytest.fixture(scope="module")
def corrected(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the mistakes, with what the answers ask for beside it."""
    path = tmp_path_factory.mktemp("remedies")
    shutil.copytree(folder, path, dirs_exist_ok=True)
    (path / "spelt.yaml").write_text(FILES["misspelt.yaml"].replace("diameter", "diameter_m"))
    (path / "indented.yaml").write_text(FILES["tab.yaml"].replace("\t", "  "))
    (path / "bracketed.yaml").write_text(FILES["flat.yaml"].replace("[0.0, 0.0, 0.0]", "[[0.0, 0.0, 0.0]]"))
    one, other = "start_m: [0, 0, 0.2], markers", "start_m: [0.6, 0, 0.2], markers"
    twins = FILES["twins.yaml"].replace("markers", one, 1)
    (path / "apart.yaml").write_text(
        twins[:-1].replace("b: {diameter_m: 0.12, markers", f"b: {{diameter_m: 0.12, {other}") + "\n"
    )
    (path / "renamed/north").mkdir(parents=True)
    (path / "named/north/frame_1.png").rename(path / "renamed/north/1500000000.png")
    shutil.copy(path / "sample/recording.mcap", path / "old.mcap")
    for name, end_s in (("recording", 2.5), ("wand", 8.0)):  # as long as the commands need
        trim(folder / f"sample/{name}.mcap", path / f"sample/{name}.mcap", to_s=end_s, force=True)
    (path / "boards/north").mkdir(parents=True)
    for k, pose in enumerate(board_poses(0.5, 8)):
        cv2.imwrite(str(path / f"boards/north/{k + 1}.png"), render(*pose))
    for rig in ("lenses", "rig"):
        save_rig(load_rig(path / f"sample/{rig}.yaml"), path / "versions.yaml")
    wand = (
        (frame.t_ns, frame.camera, frame.unpack().uv) for frame in read_detections(path / "sample/wand.mcap")
    )
    write_centres(path / "wand.csv", wand)
    # The wand of sample/wand.yaml, upright at the origin.
    upright = [[0.0, 0.0, height] for height in (0.0, 0.2, 0.5)]
    cameras = load_rig(path / "sample/rig.yaml").cameras.items()
    seen = [(1_000 * k, name, camera.project_world(upright)) for k in range(10) for name, camera in cameras]
    write_centres(path / "standing.csv", seen)
    (path / "recorded").mkdir()
    return path


@pytest.mark.ci
@pytest.mark.parametrize("of_wand", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_remedies_work(of_wand: bool, corrected: Path, monkeypatch: pytest.MonkeyPatch):
    """Each command to which the answers lead ends without an error, in the order of the table."""
    monkeypatch.chdir(corrected)
    failed = {}
    for command, mistakes in followed(REMEDIES).items():
        if ("calibrate wand" in command or "replay sample/wand" in command) is not of_wand:
            continue  # each takes as long as all the others
        try:
            code = execute(*shlex.split(command)[1:])
        except RoundelError as error:
            code = printable(error)
        if code not in (0, None):
            failed[command] = (mistakes, code)
    assert not failed


@pytest.mark.ci
def test_the_remedies_work_in_a_running_arena(corrected: Path, monkeypatch: pytest.MonkeyPatch):
    """The server tracks robot a, and its cameras see another one. A check of its health finds the camera that sends
    nothing."""
    monkeypatch.chdir(corrected)
    with serving_an_unknown_robot(corrected) as (endpoint, client):
        camera = CameraRegistration(id="1", driver="test", name="north")
        send_request(client.session, register_key("test"), encode(camera))
        for command in followed(LIVE_REMEDIES):
            words = shlex.split(command)[1:]
            assert execute(*words, "--connect", endpoint, "--arena", "test") != 2, command
        for command in ("cameras", "robots"):  # without an action, which is list then
            assert execute(command, "--connect", endpoint, "--arena", "test") == 0
    assert execute("recordings", "list", "recorded") == 0


@pytest.mark.ci
def test_the_remedies_that_start_an_arena_work(tmp_path: Path):
    """A number, a name, a port, and no file of robots."""
    port = free_port()
    words = ("--fps", 30, "--arena", "my_arena", "--port", port, "--listen", "tcp/127.0.0.1:0")
    up = Program(roundel_command("up", "lab", *words, "--source"), tmp_path)
    try:
        up.until("server of arena 'my_arena'")
        up.until(f"open http://127.0.0.1:{port} in a browser")
    finally:
        assert up.stop() == 0
