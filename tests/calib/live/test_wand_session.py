# SPDX-License-Identifier: BSD-3-Clause
"""A wave before running cameras tells how far it is, and ends when more would not help."""

import io
import shlex
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zenoh
from rich.console import Console

from calib.__main__ import execute
from calib.commands.connection import Connection
from calib.commands.wand import Wand
from calib.errors import CalibrationError
from calib.live.collect import CollectedFrames
from calib.live.wand_session import IDLE_S, Rule, SessionProgress, Trial, progress, thin, wave
from calib.rig.recording import read_wave
from calib.rig.rig import load_rig, save_rig
from camera_node.protocol.messages import Detections, Keys, encode
from camera_node.protocol.session import open_client, open_router
from tests.calib.synthetic import assert_near, record, ring
from tests.conftest import free_port


@contextmanager
def sending(
    messages: list[Detections], endpoint: str | None = None
) -> Iterator[tuple[zenoh.Session, Callable[[], None]]]:
    """A client of a router that publishes messages, and junk, as soon as somebody listens."""
    endpoint = endpoint or f"tcp/127.0.0.1:{free_port()}"
    listening = threading.Event()
    with open_router([endpoint]) as router, open_client([endpoint]) as client:
        block = zenoh.CongestionControl.BLOCK  # so fast, nothing must be dropped
        sender = router.declare_publisher(Keys("test").detections("cam0"), congestion_control=block)
        sender.declare_matching_listener(lambda status: listening.set())

        def send() -> None:
            assert listening.wait(60)
            for payload in [b"no message", *map(encode, messages)]:
                sender.put(payload)

        thread = threading.Thread(target=send)
        thread.start()
        yield client, lambda: thread.join(20)


def test_it_ends_by_itself():
    """20 s of a wave at 0.02 px, all at once: the first trial says that a pixel's noise is what counts."""
    arena, told = ring(3), []
    with sending(record(arena, 20.0, sigma_px=0.02)) as (client, done):
        heard, why = wave(client, "test", arena.intrinsics, arena.wand, 90.0, told.append, every_s=1.0)
        done()
    assert (len(heard.messages), heard.bad) == (600, 1)
    assert why == "more waving would not help"
    assert told[-1].enough
    assert told[-1].trial.expected_mm < 1
    assert set(told[-1].frames) == {"cam0", "cam1", "cam2"}
    assert told[-1].advice == "that is enough"


def test_it_is_ended_by_time_or_by_hand():
    arena, ended = ring(2), threading.Event()

    def tell(told: SessionProgress) -> None:
        if sum(told.frames.values()):
            ended.set()

    with sending(record(arena, 1.0)) as (client, done):
        why = wave(client, "test", arena.intrinsics, arena.wand, 60.0, tell, ended, trials=False)[1]
        done()
        assert why == "ended by hand"
        with pytest.raises(CalibrationError, match="no detections on test/"):
            wave(client, "test", arena.intrinsics, arena.wand, 0.1, trials=False)


def test_ctrl_c_keeps_what_came():
    arena = ring(2)

    def interrupt(told: SessionProgress) -> None:
        if sum(told.frames.values()):
            raise KeyboardInterrupt

    with sending(record(arena, 1.0)) as (client, done):
        heard, why = wave(client, "test", arena.intrinsics, arena.wand, 60.0, interrupt, trials=False)
        done()
    assert heard.messages
    assert why.startswith("Ctrl-C")


def test_cameras_that_stop_sending_are_named():
    """By when each was heard last, with roundels or without."""
    heard = CollectedFrames()
    for message in record(ring(2), 1.0):
        heard.take(encode(message), 5.0 if message.camera == "cam0" else 1.0)
    assert heard.silent(2.9) == []
    assert progress(heard, 5.0, None, False).advice == "'cam1': no frames any more; does its program run?"
    assert progress(heard, 8.0, None, False).advice == "no camera sends any more: does the server run?"


def test_the_rule():
    """Precise and covered is enough; precise and idle for long too; a camera that is missing never is."""
    good = Trial(strain={"a": 0.3, "b": 0.1}, used={"a": 0.6, "b": 0.9})
    thin_ = Trial(strain=good.strain, used={"a": 0.2, "b": 0.9}, advice={"a": "wave in its left"})
    weak = Trial(strain={"a": 0.4, "b": 0.1}, used=good.used)
    assert Rule().judge(good, 10.0)
    assert not Rule().judge(weak, 10.0)  # (1 + 0.4^2)^1/2 = 1.077
    rule = Rule()
    assert not rule.judge(thin_, 10.0)
    assert not rule.judge(thin_, 10.0 + IDLE_S)
    assert rule.judge(thin_, 10.1 + IDLE_S)
    missing = Trial(strain=good.strain, used=good.used, unplaced={"c": "never saw the wand; wave before it"})
    assert not rule.judge(missing, 99.0)
    heard = CollectedFrames(frames=Counter({"a": 1, "b": 1, "c": 1}))
    advice = [
        progress(heard, 5.0, trial, False).advice
        for trial in (None, thin_, weak, missing, Trial("it failed"))
    ]
    assert advice == [
        "wave the wand where two cameras or more see it",
        "a: wave in its left",
        "go on, most before 'a'",
        "'c' has no place yet: never saw the wand; wave before it",
        "it failed",
    ]


def test_a_wave_whose_solution_fails_is_kept_and_the_command_told_tries_it_again(
    tmp_path: Path, endpoint: str
):
    """By a wand file with a wrong length nothing is placed; once it is mended, the wave need not be waved again."""
    arena, sent = ring(3), record(ring(3), 6.0)
    save_rig(arena.intrinsics, tmp_path / "lenses.yaml")
    (tmp_path / "wand.yaml").write_text("{diameter_m: 0.12, markers: [[0, 0, 0], [0.25, 0, 0], [0.5, 0, 0]]}")
    server, told = Connection(connect=(endpoint,), arena="test"), io.StringIO()
    wand, out = tmp_path / "wand.yaml", tmp_path / "out.yaml"
    command = Wand(wand=wand, rig=tmp_path / "lenses.yaml", out=out, live=True, seconds=4.0, server=server)
    with sending(sent, endpoint) as (_, done):
        with pytest.raises(CalibrationError, match="symmetric"):
            command.execute(Console(file=told, width=200))
        done()
    kept = tmp_path / "out.wave.mcap"
    assert sorted(m.t_ns for m in read_wave(kept)) == sorted(m.t_ns for m in sent)
    assert sorted(tmp_path.glob(".*")) == []
    again = shlex.split(told.getvalue().split("to try it again: ")[1])
    (tmp_path / "wand.yaml").write_text("{diameter_m: 0.12, markers: [[0, 0, 0], [0.2, 0, 0], [0.5, 0, 0]]}")
    assert again[:3] == ["python", "-m", "calib"]
    execute(again[3:])
    assert_near(load_rig(out), arena.truth, 2e-4, 2e-4)  # no noise


def test_a_part_holds_whole_runs_of_all_cameras():
    """Half seconds are taken whole, evenly over the recording."""
    messages = record(ring(2), 20.0)
    part = thin(messages, frames=50)
    assert {name: n for name, n in Counter(m.camera for m in part).items()} == {"cam0": 50, "cam1": 50}
    seqs = [m.seq for m in part if m.camera == "cam0"]
    assert seqs[:6] == [0, 1, 2, 3, 4, 20]
    assert seqs[-1] > 150
