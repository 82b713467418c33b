# SPDX-License-Identifier: BSD-3-Clause
"""Damage costs a recording the chunk that it is in, every reader says what is missing, and no file takes all memory."""

import random
import struct
import subprocess
import sys
import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest
import zstandard
from mcap.reader import NonSeekingReader, make_reader

from calib.rig.recording import RecordingWriter, read_messages
from calib.rig.recording_reader import MAGIC, RecordingReader
from calib.rig.recording_repair import repair_recording
from calib.rig.rig import Rig
from calib.rig.rig_messages import RigMessage
from camera_node.foundation.errors import ConfigError
from camera_node.protocol.messages import encode
from fusion.recordings.arena_recording import read_recording
from fusion.recordings.recording_files import trim_recording
from fusion.recordings.rotation import RotatingWriter, Rotation
from tests.conftest import ROOT
from tests.fusion.serving import ARENA, KEYS
from tests.processes import run_program

pytestmark = pytest.mark.computed
SAMPLE = ROOT / "configs" / "sample" / "recording.mcap"
N_SAMPLE = 1502  # messages
EXPANDED = 1 << 28  # bytes: more than twice the memory that a reader may take
Entry = tuple[str, bytes, int]


def write(path: Path, n: int = 210, size: int = 1000) -> list[Entry]:
    noise = random.Random(1)
    entries = [(f"arena/camera/c{k % 3}/detections", noise.randbytes(size), 10**9 * k) for k in range(n)]
    with RecordingWriter(path) as writer:
        for entry in entries:
            writer.put(*entry)
    return entries


def chunk_starts(path: Path) -> list[int]:
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return [chunk.chunk_start_offset for chunk in summary.chunk_indexes]


def read(path: Path) -> tuple[list[Entry], RecordingReader]:
    with path.open("rb") as file:
        reader = RecordingReader(file)
        return [(m.key, m.data, m.t_ns) for m in reader], reader


def damaged_sample(folder: Path, at: int = 6) -> Path:
    """The sample with a wrong byte in the middle of one of its chunks."""
    path = folder / "damaged.mcap"
    data = bytearray(SAMPLE.read_bytes())
    start = chunk_starts(SAMPLE)[at]
    data[start + 2000] ^= 0x10
    path.write_bytes(data)
    return path


@pytest.mark.ci
def test_a_wrong_byte_anywhere_costs_one_chunk_and_is_reported(tmp_path: Path):
    """At every byte of the records' headers, and at random elsewhere: a message that is not read is counted, and its
    time is. A repair makes the file readable for other readers, too, and says the same."""
    path, wrong = tmp_path / "a.mcap", tmp_path / "wrong.mcap"
    entries = write(path)
    whole, starts = path.read_bytes(), chunk_starts(path)
    assert len(starts) == 4
    noise = random.Random(2)
    headers = {start + k for start in (len(MAGIC), *starts) for k in range(56)}
    elsewhere = {noise.randrange(len(MAGIC), len(whole)) for _ in range(200)}
    tail = set(range(len(whole) - 45, len(whole)))
    for at in sorted(headers | elsewhere | tail):
        data = bytearray(whole)
        data[at] ^= 1 << noise.randrange(8)
        wrong.write_bytes(data)
        found, reader = read(wrong)
        assert set(found) <= set(entries)
        assert found == sorted(found, key=lambda entry: entry[2])
        n_missing = len(entries) - len(found)
        assert n_missing <= 70, at
        if reader.has_header and reader.n_damaged:  # at the end only an intact index knows how many
            assert reader.n_missing == n_missing or not reader.is_complete, at
            assert abs(reader.missing_s - n_missing) <= 1, at
        assert (n_missing == 0) or reader.faults(), at
        n_found = len(found)
        repair = repair_recording(wrong)
        found, repaired = read(wrong)  # a chunk of which only the length was wrong is readable again
        assert repair.n_messages == len(found) >= n_found, at
        assert repair_recording(wrong).was_complete, at
        # The first chunk has the channels, which a reader without the index can't do without.
        for kind in (make_reader, NonSeekingReader) if entries[0] in found else (make_reader,):
            with wrong.open("rb") as file:
                assert [m.log_time for _, _, m in kind(file).iter_messages()] == [e[2] for e in found], at
        if len(found) == n_found:
            assert (repaired.n_damaged, repaired.missing_s) == (reader.n_damaged, reader.missing_s), at


@pytest.mark.parametrize("is_shifted", [False, True])
def test_a_damaged_first_chunk_without_the_index_costs_no_other(tmp_path: Path, is_shifted: bool):
    """Before: the first chunk alone defined the channels, and with it every message was lost. Bytes that are inserted
    invalidate the index, too."""
    path = tmp_path / "a.mcap"
    entries = write(path, n=400)
    data, starts = path.read_bytes(), chunk_starts(path)
    at = starts[0] + 3000
    cut_off = data[:at] + bytes(1) + data[at + 1 : starts[-1]]
    path.write_bytes(data[:at] + bytes(77) + data[at:] if is_shifted else cut_off)
    found, reader = read(path)
    first = entries.index(found[0])
    assert found == entries[first:][: len(found)]
    assert 0 < first <= 70  # as many as a chunk has
    assert first + len(found) == len(entries) if is_shifted else first + len(found) >= len(entries) - 70
    assert reader.n_damaged
    assert repair_recording(path).n_messages == len(found)


@pytest.mark.ci
def test_a_damaged_recording_of_an_arena_is_used_and_described(tmp_path: Path):
    """Each command goes on, and says how many messages and seconds are missing."""
    path = damaged_sample(tmp_path)
    found, reader = read(path)
    n, seconds = N_SAMPLE - len(found), f"{reader.missing_s:.2f} s"
    assert 0 < n < 120
    assert 0.3 < reader.missing_s < 0.6  # of eight seconds in 18 chunks
    said = f"{n} messages in 1 damaged part of the recording, {seconds} in all"
    commands = [
        ["fusion", "replay", path, "--out", tmp_path / "poses.csv"],
        ["fusion", "trim", path, tmp_path / "part.mcap"],
        ["fusion", "export", path, tmp_path / "part.csv"],
        ["fusion", "plot", path, "--out", tmp_path / "part.png"],
        ["fusion", "repair", path, "--out", tmp_path / "repaired.mcap"],
        ["fusion", "repair", tmp_path / "repaired.mcap"],
        ["fusion", "replay", tmp_path / "repaired.mcap", "--out", tmp_path / "again.mcap"],
    ]
    for words in commands:
        done = run_program(*words)
        assert done.returncode == 0, (words, done.stderr)
        assert "Traceback" not in done.stderr
        assert said in done.stdout + done.stderr, (words, done.stdout, done.stderr)
    assert (
        f"is complete: {len(found)} messages"
        in run_program("fusion", "repair", tmp_path / "part.mcap").stdout
    )


def test_a_rig_in_a_damaged_part_is_missed_with_the_damage(tmp_path: Path):
    """Before: the error advised another rig, and said nothing of the damage."""
    done = run_program("fusion", "replay", damaged_sample(tmp_path, at=0), "--out", tmp_path / "poses.csv")
    assert done.returncode == 2
    assert "holds no rig and no robots (skipped: " in done.stderr
    assert "1 damaged part" in done.stderr


def test_a_strict_reader_refuses_a_damaged_recording(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"is not whole: .* messages in 1 damaged part"):
        list(read_messages(damaged_sample(tmp_path)))


def test_several_passes_count_damage_once(tmp_path: Path):
    path, faults = damaged_sample(tmp_path), Counter[str]()
    passes = [list(read_messages(path, faults)) for _ in range(3)]
    assert faults == read(path)[1].faults()
    assert passes[0] == passes[2]


@pytest.mark.parametrize("is_indexed", [True, False], ids=["with index", "without index"])
def test_a_later_part_is_read_without_the_chunks_before(tmp_path: Path, is_indexed: bool):
    """A page jumps in a recording of any length. Damage before the part shows that it was read: the index spares it."""
    path = tmp_path / "a.mcap"
    entries = write(path)
    data, second = bytearray(path.read_bytes()), chunk_starts(path)[1]
    data[second + 100] ^= 1
    path.write_bytes(bytes(data) if is_indexed else bytes(data[: len(data) - 1]))
    from_ns, faults = entries[150][2], Counter[str]()
    assert list(read_messages(path, faults, from_ns=from_ns)) == entries[150:]
    assert any("damaged" in reason for reason in faults) == (not is_indexed)


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def text(word: str) -> bytes:
    return struct.pack("<I", len(word)) + word.encode()


def hostile(
    records: bytes, stated: int | None = None, check_sum: int | None = None, is_frame_sized: bool = True
) -> bytes:
    """A file whose only chunk states a size, the right one by default; its frame states the right one or none."""
    data = zstandard.ZstdCompressor(write_content_size=is_frame_sized).compress(records)
    stated = len(records) if stated is None else stated
    check_sum = zlib.crc32(records) if check_sum is None else check_sum
    chunk = struct.pack("<QQQI", 0, 1, stated, check_sum) + text("zstd") + struct.pack("<Q", len(data)) + data
    return MAGIC + record(1, text("roundel") + text("roundel")) + record(6, chunk)


def channel_and_message(size: int) -> bytes:
    channel = (
        struct.pack("<HH", 1, 0) + text("a/camera/c/detections") + text("msgpack") + struct.pack("<I", 0)
    )
    return record(4, channel) + record(5, struct.pack("<HIQQ", 1, 0, 5, 5) + bytes(size))


# The peak memory of the program itself: `getrusage` counts what its parent had, too.
PEAK_KB = """
import sys
from collections import Counter
from pathlib import Path
from calib.rig.recording import read_messages
from calib.rig.recording_repair import repair_recording
def peak_kb():
    return int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0])
path, faults, before = Path(sys.argv[1]), Counter(), peak_kb()
"""
READ_WITH_LITTLE = f"""{PEAK_KB}
n = sum(1 for _ in read_messages(path, faults))
print(n, peak_kb() - before, "|", *faults)
"""


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (lambda: hostile(bytes(EXPANDED)), "chunks of more than"),  # 256 MB in 8 kB
        (lambda: hostile(bytes(EXPANDED), stated=1 << 32), "cut off"),
        (lambda: hostile(bytes(EXPANDED), stated=1 << 20), "cut off"),
        (lambda: hostile(bytes(EXPANDED), stated=1 << 20, is_frame_sized=False), "cut off"),
        (lambda: hostile(bytes(1 << 20), check_sum=1), "cut off"),
        (lambda: hostile(channel_and_message((1 << 24) + 1)), "messages of more than"),
    ],
    ids=["chunk", "both", "frame", "frame without a size", "check sum", "message"],
)
def test_memory_is_bounded_by_what_a_chunk_may_state(tmp_path: Path, content: Callable[[], bytes], said: str):
    path = tmp_path / "hostile.mcap"
    path.write_bytes(content())
    assert path.stat().st_size < 66_000
    command = [sys.executable, "-c", READ_WITH_LITTLE, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=True)
    counts, reasons = done.stdout.split("|")
    n, grown_kb = map(int, counts.split())
    assert n == 0
    assert grown_kb < 100_000
    assert said in reasons


def test_larger_chunks_are_rewritten_on_request(tmp_path: Path):
    """Recordings of other programs may have larger chunks; the option of one command makes them readable by all."""
    path, out = tmp_path / "large.mcap", tmp_path / "small.mcap"
    records = b"".join(channel_and_message(8_000_000) for _ in range(5))
    path.write_bytes(hostile(records))
    assert read(path)[0] == []
    refused = run_program("fusion", "repair", path)
    assert refused.returncode == 2
    assert "--max-chunk-mb" in refused.stderr
    done = run_program("fusion", "repair", path, "--out", out, "--max-chunk-mb", "50")
    assert done.returncode == 0, done.stderr
    found, reader = read(out)
    assert len(found) == 5
    assert not reader.faults()
    assert reader.is_complete


REPAIR_WITH_LITTLE = f"""{PEAK_KB}
print(repair_recording(path).n_messages, peak_kb() - before)
"""


def test_a_recording_that_is_larger_than_the_memory_is_repaired(tmp_path: Path):
    """Its chunks are read one after the other: the memory grows by a few of them, not by the file's 60 MB."""
    path, n = tmp_path / "large.mcap", 600
    write(path, n, size=100_000)
    with path.open("rb+") as file:
        file.truncate(path.stat().st_size - 50_000)
    command = [sys.executable, "-c", REPAIR_WITH_LITTLE, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=True)
    found, grown_kb = map(int, done.stdout.split())
    assert n - 20 < found < n
    assert grown_kb < 20_000


def test_an_empty_part_replaces_no_recording(tmp_path: Path):
    source, out = tmp_path / "source.mcap", tmp_path / "part.mcap"
    entries = write(source, 12)
    with pytest.raises(ConfigError, match=r"no message after 100 s; it is 11\.0 s long"):
        trim_recording(source, out, 100.0, 200.0)
    assert not out.exists()
    assert trim_recording(source, out, 3.0, 5.0) == 3
    assert read(out)[0] == entries[3:6]
    with pytest.raises(ConfigError, match="exists; give another name, or --force"):
        trim_recording(source, out, 0.0, 1.0)
    with pytest.raises(ConfigError, match="no message after"):
        trim_recording(source, out, 100.0, 200.0, overwrite=True)
    assert read(out)[0] == entries[3:6]
    assert sorted(tmp_path.iterdir()) == [out, source]


def test_a_rig_that_can_t_be_read_replaces_none(tmp_path: Path):
    """After a message under the rig's key that is no rig, a part and the next file of a rotation begin with the rig
    before it. Both began with that message, so they could not be replayed."""
    source, part, rotated = tmp_path / "source.mcap", tmp_path / "part.mcap", tmp_path / "next.mcap"
    rig = RigMessage(t_ns=0, rig=Rig(cameras=ARENA.cameras))
    seen = [encode(message) for message in ARENA.messages(1)]
    entries = [(KEYS.rig, encode(rig), 0), (KEYS.rig, b"garbage", 1), (KEYS.detections("cam0"), seen[0], 2)]
    with RecordingWriter(source) as writer, RotatingWriter(rotated, Rotation(max_mb=1e-6)) as files:
        for key, data, s in entries:
            writer.put(key, data, 10**18 + s * 10**9)
            files.put(key, data, 10**18 + s * 10**9)
        last = files.path
    trim_recording(source, part, 1.5, 10.0)
    for path in (part, last):
        found = read_recording(path).rig
        assert found is not None
        assert found.cameras == ARENA.cameras
