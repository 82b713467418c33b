# SPDX-License-Identifier: BSD-3-Clause
"""A wand session reports its progress, and ends when more frames would not improve the result."""

import shlex
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import count
from multiprocessing import active_children
from pathlib import Path

import msgspec
import psutil
import pytest
import zenoh

from calib.__main__ import execute
from calib.commands.calibrate_wand import Wand
from calib.errors import CalibrationError
from calib.live.collect import CollectedFrames
from calib.live.live_session import (
    GONE_S,
    SessionProgress,
    StoppingRule,
    is_wand_gone,
    run_wand_session,
    summarize,
)
from calib.live.trials import Trial, TrialSolver, WandSession, select_blocks
from calib.rig.recording import read_detections
from calib.rig.rig import load_rig, save_rig
from camera_node.protocol.messages import Detections, Keys, encode
from camera_node.protocol.server_connection import Connection
from camera_node.protocol.session import open_client, open_router
from tests.calib.synthetic import assert_near, record, ring
from tests.conftest import ROOT, free_port
from tests.waiting import DEADLINE_S, wait_for


@contextmanager
def sending(
    messages: list[Detections], endpoint: str | None = None
) -> Iterator[tuple[zenoh.Session, Callable[[], None]]]:
    """A client of a router that publishes an invalid message and then these, as soon as there is a subscriber; and a
    function that waits for the end."""
    endpoint = endpoint or f"tcp/127.0.0.1:{free_port()}"
    listening = threading.Event()
    with open_router([endpoint]) as router, open_client([endpoint]) as client:
        block = zenoh.CongestionControl.BLOCK  # nothing may be dropped at this rate
        sender = router.declare_publisher(Keys("test").detections("cam0"), congestion_control=block)
        sender.declare_matching_listener(lambda status: listening.set())

        def send() -> None:
            assert listening.wait(60)
            for payload in [b"no message", *map(encode, messages)]:
                sender.put(payload)

        thread = threading.Thread(target=send)
        thread.start()
        yield client, lambda: thread.join(20)


@pytest.mark.ci
def test_a_session_ends_when_a_trial_is_precise_enough():
    """20 s of recording at 0.02 px, all at once: by the first trial, pixel noise dominates."""
    arena, shown = ring(3), []
    settings = WandSession(
        rig=arena.intrinsics, wand=arena.wand, seconds=90.0, trial_every_s=1.0, stops_without_wand=False
    )
    with sending(record(arena, 20.0, sigma_px=0.02)) as (client, done):
        collected, reason = run_wand_session(client, "test", settings, shown.append)
        done()
    assert (len(collected.messages), collected.invalid) == (600, 1)
    assert "more frames would not improve" in reason
    assert shown[-1].enough
    assert shown[-1].trial.expected_mm < 1
    assert set(shown[-1].frames) == {"cam0", "cam1", "cam2"}
    assert not any(progress.enough for progress in shown[:-1])


def test_a_session_ends_after_its_time_or_by_the_user():
    arena, stop = ring(2), threading.Event()
    settings = WandSession(rig=arena.intrinsics, wand=arena.wand, seconds=60.0, trials=False)

    def show(progress: SessionProgress) -> None:
        if sum(progress.frames.values()):
            stop.set()

    with sending(record(arena, 1.0)) as (client, done):
        reason = run_wand_session(client, "test", settings, show, stop)[1]
        done()
        assert "by the user" in reason
        with pytest.raises(CalibrationError, match="no camera of arena 'test' sent"):
            run_wand_session(client, "test", replace(settings, seconds=0.1))


GOOD = Trial(noise_ratio={"a": 0.3, "b": 0.1}, used={"a": 0.6, "b": 0.9})
SPARSE = replace(GOOD, used={"a": 0.2, "b": 0.9}, advice={"a": "wave in its left"})
NOISY = replace(GOOD, noise_ratio={"a": 0.4, "b": 0.1})  # (1 + 0.4^2)^1/2 = 1.077
INCOMPLETE = replace(GOOD, unplaced={"c": "it never saw the wand"})


def waved(seconds: float, at_s: float) -> CollectedFrames:
    """Frames of a waved wand, whose last one arrived at a time of the session."""
    collected = CollectedFrames()
    messages = sorted(record(ring(2), seconds), key=lambda message: message.t_ns)
    for message in messages:
        collected.add(encode(message), at_s + (message.t_ns - messages[-1].t_ns) * 1e-9)
    return collected


def test_frames_that_a_driver_delivers_twice_count_once():
    """Their stamps differ by nanoseconds, by what the node learned of its clock in between."""
    collected, messages = CollectedFrames(), record(ring(2), 1.0)
    for message in messages:
        for later_ns in (0, 20):
            collected.add(encode(msgspec.structs.replace(message, t_ns=message.t_ns + later_ns)), 1.0)
    assert collected.messages == messages


def test_a_session_without_a_wand_ends_once_the_cameras_are_placed():
    """Roundels that do not move are no wand. Before the first motion there is nothing to end."""
    collected, still = waved(3.0, at_s=5.0), CollectedFrames()
    last = max(record(ring(2), 3.0), key=lambda message: message.t_ns)
    for k in range(60):
        later = msgspec.structs.replace(last, t_ns=last.t_ns + (k + 1) * 10**9)
        collected.add(encode(later), 5.0 + k)
        still.add(encode(later), 5.0 + k)
    assert collected.moved_s is not None
    assert 4.0 < collected.moved_s < 6.5
    assert still.moved_s is None
    end_s = collected.moved_s + GONE_S
    for trial, trials, ends in (
        (GOOD, True, True),
        (SPARSE, True, True),
        (INCOMPLETE, True, False),
        (Trial("it failed"), True, False),
        (None, True, False),
        (None, False, True),
    ):
        assert not is_wand_gone(collected, end_s - 0.1, trial, trials)
        assert is_wand_gone(collected, end_s + 0.1, trial, trials) == ends
    assert not is_wand_gone(still, 99.0, GOOD, True)


def test_a_pause_is_reported():
    collected = waved(3.0, at_s=5.0)
    assert "moved" not in summarize(collected, 6.0, GOOD, False).advice
    collected.last_seen_s = dict.fromkeys(collected.last_seen_s, 10.0)
    assert summarize(collected, 10.0, GOOD, False).advice.startswith("no roundel has moved for 5 s: wave on")


def test_ctrl_c_ends_a_session_and_keeps_its_frames():
    arena = ring(2)
    settings = WandSession(rig=arena.intrinsics, wand=arena.wand, seconds=60.0, trials=False)

    def interrupt(progress: SessionProgress) -> None:
        if sum(progress.frames.values()):
            raise KeyboardInterrupt

    with sending(record(arena, 1.0)) as (client, done):
        collected, reason = run_wand_session(client, "test", settings, interrupt)
        done()
    assert collected.messages
    assert reason.startswith("Ctrl-C")


def test_cameras_that_stop_sending_are_named():
    """By the time of the last message of each, with roundels or without."""
    collected = CollectedFrames()
    for message in record(ring(2), 1.0):
        collected.add(encode(message), 5.0 if message.camera == "cam0" else 1.0)
    assert collected.silent_cameras(2.9) == []
    assert summarize(collected, 5.0, None, False).advice.startswith("'cam1': no frames")
    assert summarize(collected, 8.0, None, False).advice.startswith("no camera sends")


def test_the_stopping_rule_needs_all_cameras_precise_and_the_area_used_or_idle():
    assert StoppingRule().is_met(GOOD, 10.0)
    assert not StoppingRule().is_met(NOISY, 10.0)
    rule = StoppingRule()
    assert not rule.is_met(SPARSE, 10.0)
    assert not rule.is_met(SPARSE, 10.0 + GONE_S)
    assert rule.is_met(SPARSE, 10.1 + GONE_S)
    assert not rule.is_met(INCOMPLETE, 99.0)


@pytest.mark.parametrize(
    ("trial", "words"),
    [
        (None, "two cameras or more"),
        (SPARSE, "a: wave in its left"),
        (NOISY, "'a'"),
        (INCOMPLETE, "'c' is not placed yet: it never saw the wand"),
        (Trial("it failed"), "it failed"),
    ],
)
def test_the_advice_is_about_the_weakest_camera(trial: Trial | None, words: str):
    collected = CollectedFrames(frames=Counter({"a": 1, "b": 1, "c": 1}))
    assert words in summarize(collected, 5.0, trial, False).advice


@pytest.mark.ci
def test_a_recording_is_saved_and_can_be_calibrated_again_by_the_printed_command(
    tmp_path: Path, endpoint: str, capsys: pytest.CaptureFixture[str]
):
    """With a wrong length in the wand file the calibration fails; with the right one the printed command succeeds."""
    arena, sent = ring(3), record(ring(3), 6.0)
    save_rig(arena.intrinsics, tmp_path / "lenses.yaml")
    (tmp_path / "wand.yaml").write_text("{diameter_m: 0.12, markers: [[0, 0, 0], [0.25, 0, 0], [0.5, 0, 0]]}")
    connection = Connection(connect=(endpoint,), arena="test")
    wand, out = tmp_path / "wand.yaml", tmp_path / "out.yaml"
    command = Wand(
        wand=wand, rig=tmp_path / "lenses.yaml", out=out, live=True, seconds=4.0, connection=connection
    )
    with sending(sent, endpoint) as (_, done):
        with pytest.raises(CalibrationError, match="differs from its file"):
            command.run()
        done()
    recording = tmp_path / "out.wave.mcap"
    assert sorted(m.t_ns for m in read_detections(recording)) == sorted(m.t_ns for m in sent)
    assert sorted(tmp_path.glob(".*")) == []
    (printed,) = [line for line in capsys.readouterr().out.splitlines() if "roundel calibrate" in line]
    words = shlex.split(printed[printed.index("roundel calibrate") :])
    (tmp_path / "wand.yaml").write_text("{diameter_m: 0.12, markers: [[0, 0, 0], [0.2, 0, 0], [0.5, 0, 0]]}")
    execute(words[2:])
    assert_near(load_rig(out), arena.truth, 2e-4, 2e-4)  # no noise


def test_a_trial_whose_process_ends_is_reported_and_the_next_one_succeeds():
    """Also if the process ends while it waits for the next trial."""
    arena, now_s = ring(3), count(10.0, 10.0)
    messages = record(arena, 8.0)

    def end_process() -> None:
        for process in active_children():
            process.kill()
            process.join(DEADLINE_S)

    with TrialSolver(WandSession(rig=arena.intrinsics, wand=arena.wand)) as solver:

        def solved() -> Trial | None:
            trial = solver.update(messages, next(now_s))
            return trial if trial is not None and not trial.fault else None

        assert solver.update(messages, next(now_s)) is None
        end_process()
        trial = wait_for(lambda: solver.update(messages, next(now_s)))
        assert trial is not None
        assert "the process of the trials ended" in trial.fault
        first = wait_for(solved)
        end_process()
        wait_for(lambda: (trial := solved()) is not None and trial is not first)


def test_a_killed_session_leaves_no_process():
    """SIGKILL gives it no chance to end the process of its trials."""
    code = (
        "import sys\n"
        "from calib.live.trials import TrialSolver, WandSession\n"
        "from tests.calib.synthetic import record, ring\n"
        "from tests.waiting import wait_for\n"
        "arena = ring(2)\n"
        "messages = record(arena, 2.0)\n"
        "solver = TrialSolver(WandSession(rig=arena.intrinsics, wand=arena.wand, trial_every_s=0.0))\n"
        "wait_for(lambda: solver.update(messages, 1.0))\n"
        "print(flush=True)\n"
        "sys.stdin.read()\n"
    )
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as session:
        assert session.stdout is not None
        session.stdout.readline()
        children = psutil.Process(session.pid).children()
        session.kill()
    assert children
    assert not psutil.wait_procs(children, timeout=DEADLINE_S)[1]


def test_blocks_are_contiguous_and_evenly_spaced():
    """Blocks of half a second, of all cameras, over the whole recording."""
    messages = record(ring(2), 20.0)
    part = select_blocks(messages, frames=50)
    assert {name: n for name, n in Counter(m.camera for m in part).items()} == {"cam0": 50, "cam1": 50}
    seqs = [m.seq for m in part if m.camera == "cam0"]
    assert seqs[:6] == [0, 1, 2, 3, 4, 20]
    assert seqs[-1] > 150
