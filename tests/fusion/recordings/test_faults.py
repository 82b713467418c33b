# SPDX-License-Identifier: BSD-3-Clause
"""Recordings survive what happens to recorders: existing files, signals, full disks, power cuts."""

import errno
import math
import os
import random
import signal
import subprocess
import sys
import tracemalloc
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from mcap.reader import make_reader

from calib.rig.recording import MAX_LOST, MIN_CHUNK, RecordingWriter, read_messages
from calib.rig.recording_repair import repair_recording
from camera_node.foundation.errors import ConfigError
from camera_node.protocol.server_connection import Connection
from fusion.commands.record import record
from fusion.commands.repair import repair
from fusion.recordings.arena_recording import read_recording
from tests.conftest import ROOT
from tests.fusion.serving import ARENA, KEYS, config, live, send, serving
from tests.processes import killed_at_end, run_program
from tests.waiting import DEADLINE_S, wait_for

pytestmark = pytest.mark.computed
LIMIT = 200_000  # bytes that the full disk of these tests holds
Entry = tuple[str, bytes, int]
FULL_DISK = """
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv.pop(1)), resource.RLIM_INFINITY))
from fusion.__main__ import main
main()
"""


def entries(n: int, size: int = 900) -> list[Entry]:
    """Messages that do not compress, on three keys."""
    noise = random.Random(1)
    return [(f"arena/camera/cam{i % 3}/detections", noise.randbytes(size), 1000 + i) for i in range(n)]


def write(path: Path, messages: list[Entry]) -> None:
    with RecordingWriter(path) as writer:
        for entry in messages:
            writer.put(*entry)


def indexed(path: Path) -> list[Entry]:
    """The messages as MCAP's own reader delivers them, which refuses files without an index."""
    with path.open("rb") as file:
        return [
            (channel.topic, message.data, message.log_time)
            for _, channel, message in make_reader(file, validate_crcs=True).iter_messages()
        ]


@contextmanager
def recorder(
    folder: Path, *words: str, program: str = "from fusion.__main__ import main; main()"
) -> Iterator[tuple]:
    """`fusion record` as a process, beside a server whose cameras publish; yields the process and a publisher."""
    with serving(config(folder)) as (server, _):
        arguments = ["--connect", server.endpoints[0], "--arena", "test"]
        command = [sys.executable, "-c", program, *words, *arguments]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        with killed_at_end(command, cwd=ROOT, text=True, **pipes) as process:
            yield process, lambda: send(server, live(ARENA.messages(3)))


def test_what_a_cut_off_loses_and_what_the_recorder_remembers_are_a_small_share(tmp_path: Path):
    """Chunks grow with the file."""
    size = 30_000
    write(tmp_path / "long.mcap", entries(1500, size))
    with (tmp_path / "long.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    chunks = [(chunk.chunk_start_offset, chunk.uncompressed_size) for chunk in summary.chunk_indexes]
    assert all(chunk < max(MIN_CHUNK, MAX_LOST * offset) + 2 * size for offset, chunk in chunks)
    end = MAX_LOST * (tmp_path / "long.mcap").stat().st_size / MIN_CHUNK
    assert end > 2  # so that the chunks must have grown
    assert len(chunks) <= (1 + math.log(end)) / MAX_LOST


def test_the_recorder_remembers_a_chunk_in_a_kilobyte_however_many_keys_it_holds(tmp_path: Path):
    """With an index of each key in each chunk it was 15 kB here, and several MB a minute for 200 robots at 60 Hz."""
    noise, keys, chunks = random.Random(1).randbytes(MIN_CHUNK // 200), 200, 40
    with RecordingWriter(tmp_path / "long.mcap") as writer:

        def write_chunks(n: int) -> int:
            for k in range(n * keys):
                writer.put(f"arena/robot/r{k % keys}/pose", noise, k)
            return tracemalloc.get_traced_memory()[0]

        tracemalloc.start()
        try:
            before = write_chunks(4)  # the channels
            grown = write_chunks(chunks) - before
        finally:
            tracemalloc.stop()
    assert grown < 1000 * chunks


def test_an_empty_recording_is_reported(tmp_path: Path, endpoint: str, capsys: pytest.CaptureFixture[str]):
    """No server is there: the exit code is 1, and the last line says why the file is empty."""
    assert record(tmp_path / "x.mcap", connection=Connection(connect=(endpoint,)), seconds=0.2) == 1
    last = capsys.readouterr().out.splitlines()[-1]
    assert last == f"warning: the recording is empty: no message of arena 'arena' arrived from {endpoint}"


def test_an_existing_recording_is_not_overwritten(tmp_path):
    write(tmp_path / "a.mcap", entries(3))
    before = (tmp_path / "a.mcap").read_bytes()
    words = ["fusion", "record", tmp_path / "a.mcap", "--seconds", "0.1"]
    done = run_program(*words)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "--force" in done.stderr
    assert (tmp_path / "a.mcap").read_bytes() == before
    # without a server it is empty, which the command reports
    assert run_program(*words, "--force").returncode == 1
    assert indexed(tmp_path / "a.mcap") == []


@pytest.mark.ci
@pytest.mark.parametrize("number", [pytest.param(signal.SIGTERM, marks=pytest.mark.ci), signal.SIGINT])
def test_a_signal_closes_the_recording(tmp_path, number):
    path = tmp_path / "live.mcap"
    with recorder(tmp_path, "record", str(path)) as (process, publish):
        wait_for(lambda: path.exists() and path.stat().st_size > 50_000, publish)
        process.send_signal(number)
        out, errors = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 0, errors
    assert f"wrote {path}" in out
    assert KEYS.rig in {key for key, _, _ in indexed(path)}


@pytest.mark.ci
def test_a_full_disk_ends_the_recording_in_one_line(tmp_path):
    """The file is closed within the space that it has, and every message of its index is readable."""
    path = tmp_path / "live.mcap"
    with recorder(tmp_path, str(LIMIT), "record", str(path), program=FULL_DISK) as (process, publish):
        wait_for(lambda: process.poll() is not None, publish)
        _, errors = process.communicate(timeout=DEADLINE_S)
    lines = [line for line in errors.splitlines() if not line.startswith(("INFO", "WARNING"))]
    assert process.returncode == 2
    assert len(lines) == 1, errors
    assert "live.mcap" in lines[0]
    assert os.strerror(errno.EFBIG) in lines[0]
    assert LIMIT / 2 < path.stat().st_size <= LIMIT
    assert KEYS.rig in {key for key, _, _ in indexed(path)}
    assert f"{len(indexed(path))} messages" in lines[0]


@pytest.mark.parametrize(
    "words",
    [
        ("trim", "{source}", "{out}", "--force"),
        ("repair", "{source}", "--out", "{new}"),
        ("repair", "{source}", "--out", "{new}", "--max-chunk-mb", "9"),
        ("sample", "{new}"),
    ],
    ids=lambda words: " ".join(words),
)
def test_a_result_on_a_full_disk_replaces_no_file(tmp_path: Path, words: tuple[str, ...]):
    """What must appear whole is not completed: the error names the result, and nothing is left of it."""
    source, out, new = (tmp_path / f"{name}.mcap" for name in ("source", "part", "new"))
    write(source, entries(400))
    write(out, entries(10))
    before = out.read_bytes()
    filled = [word.format(source=source, out=out, new=new) for word in words]
    command = [sys.executable, "-c", FULL_DISK, str(LIMIT), *filled]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=DEADLINE_S, check=False)
    assert done.returncode == 2
    result = out if str(out) in filled else new
    assert f"error: {result} can't be written: {os.strerror(errno.EFBIG)}" in done.stderr
    assert done.stderr.count("\n") == 1
    assert out.read_bytes() == before
    assert sorted(tmp_path.iterdir()) == [out, source]


def test_a_disk_without_any_space_is_one_error():
    """/dev/full refuses every byte."""
    with pytest.raises(ConfigError, match=os.strerror(errno.ENOSPC)):
        write(Path("/dev/full"), entries(200))


def test_a_repaired_recording_is_readable_wherever_it_was_cut(tmp_path):
    """Around the ends of all chunks at every byte, and at every 499th elsewhere; whole chunks are never lost."""
    whole, cut = tmp_path / "whole.mcap", tmp_path / "cut.mcap"
    write(whole, entries(150))
    data, expected = whole.read_bytes(), indexed(whole)
    assert len(expected) == 150
    boundaries = chunk_ends(whole)
    near = {end + i for end in (8, *boundaries, len(data)) for i in range(-40, 40)}
    ends = Counter[int]()
    for size in sorted(near.union(range(8, len(data), 499)) & set(range(8, len(data)))):
        cut.write_bytes(data[:size])
        repair_recording(cut)
        found = indexed(cut)
        assert found == expected[: len(found)], size
        assert len(found) >= max((n for end, n in boundaries.items() if end <= size), default=0), size
        assert found == list(read_messages(cut)), size
        ends[len(found)] += 1
    assert sorted(ends) == [0, *boundaries.values()]


def chunk_ends(path: Path) -> dict[int, int]:
    """The position behind each chunk, and how many messages precede it."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    times = [t_ns for _, _, t_ns in indexed(path)]
    return {
        chunk.chunk_start_offset + chunk.chunk_length: sum(t_ns <= chunk.message_end_time for t_ns in times)
        for chunk in summary.chunk_indexes
    }


def test_repair_needs_a_recording(tmp_path):
    (tmp_path / "x.mcap").write_bytes(b"no MCAP at all")
    with pytest.raises(ConfigError, match=r"x\.mcap is not an MCAP recording"):
        repair(tmp_path / "x.mcap")
    with pytest.raises(ConfigError, match=r"none\.mcap"):
        repair(tmp_path / "none.mcap")


def test_repair_can_leave_the_original(tmp_path, capsys):
    write(tmp_path / "a.mcap", entries(150))
    data = (tmp_path / "a.mcap").read_bytes()[:-500]
    (tmp_path / "a.mcap").write_bytes(data)
    assert repair(tmp_path / "a.mcap", out=tmp_path / "b.mcap") == 0
    assert (tmp_path / "a.mcap").read_bytes() == data
    assert f"{len(indexed(tmp_path / 'b.mcap'))} messages" in capsys.readouterr().out
    assert repair(tmp_path / "b.mcap") == 0
    assert "is complete" in capsys.readouterr().out


@pytest.mark.ci
def test_a_recording_rotates(tmp_path):
    """Each file is readable by itself, with rig and robots; together they hold every message once."""
    path = tmp_path / "live.mcap"
    with recorder(tmp_path, "record", str(path), "--rotate-mb", "0.1") as (process, publish):
        wait_for(lambda: len(list(tmp_path.glob("live-*.mcap"))) >= 3, publish)
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=DEADLINE_S)
    files = sorted(tmp_path.glob("live-*.mcap"))
    assert [file.name for file in files[:3]] == ["live-001.mcap", "live-002.mcap", "live-003.mcap"]
    seen: Counter[tuple[str, bytes]] = Counter()
    for file in files[:-1]:
        recording = read_recording(file)
        assert recording.rig is not None
        assert recording.robots.keys() == {"a"}
        assert file.stat().st_size < 0.3e6
        seen.update((key, data) for key, data, _ in indexed(file) if key.endswith("/detections"))
    assert set(seen.values()) == {1}
