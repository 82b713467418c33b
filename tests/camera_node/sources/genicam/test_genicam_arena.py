# SPDX-License-Identifier: BSD-3-Clause
"""Four GigE cameras from their packets to poses of robots: GVSP, detection, wand calibration and fusion."""

import csv
import re
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from calib.rig.camera import transform
from camera_node.clocks.host_clock import unix_ahead_ns
from camera_node.commands.publish import open_source
from camera_node.foundation.arrays import Array
from camera_node.geometry.pose import rigid_motions
from camera_node.simulation.scene import Scene
from camera_node.sources.frame import Source, SourceSettings
from tests.camera_node.sources.genicam.fake_gige import FakeCamera, monotonic_of, stamp_in
from tests.conftest import ROOT

FPS = 8.0  # all cameras are rendered on this machine
ROBOTS_S = 6.0
START_S = 20.0  # for the programs of the cameras; the wand moves before time 0, too


def receive(source: Source, folders: dict[str, Path], wave_end_ns: int, errors_us: list[float]) -> None:
    """Write the frames of a camera as <t_ns>.png, those of the wand and those of the robots apart."""
    for frame in source:
        middle_ns = monotonic_of(stamp_in(frame.image)) + unix_ahead_ns() + frame.exposure_us * 500
        errors_us.append((frame.t_ns - middle_ns) / 1000)
        image = frame.image.copy()
        image[0, :8] = image[1, :8]  # the stamp
        folder = folders["wand" if frame.t_ns < wave_end_ns else "robots"]
        cv2.imwrite(str(folder / f"{frame.t_ns}.png"), image, [cv2.IMWRITE_PNG_COMPRESSION, 1])


def run(*words: object) -> None:
    command = [sys.executable, "-m", *map(str, words)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def localize(scene: Path, folder: Path, epoch_ns: int) -> tuple[list[Array], list[Array]]:
    """Calibrate with the frames of the wand and fuse those of the robots; measured and true positions, metres."""
    arena, demo = Scene.load(scene), scene.parent
    lenses, rig, poses = folder / "lenses.yaml", folder / "rig.yaml", folder / "poses.csv"
    lenses.write_bytes(msgspec.yaml.encode({"cameras": arena.rig_entries()}))
    options = ("--wand", demo / "wand.yaml", "--rig", lenses, "--out", rig)
    run("calib", "wand", "--frames", folder / "wand", *options)
    options = ("--rig", rig, "--robots", demo / "robots.yaml", "--out", poses)
    run("fusion", "run", "--frames", folder / "robots", *options)
    measured, true = [], []
    with poses.open() as file:
        for row in csv.DictReader(file):
            T = arena.robot_pose(row["robot"], (int(row["t_ns"]) - epoch_ns) * 1e-9)
            if row["state"] == "tracked" and T is not None:
                measured.append(np.array([float(row[axis]) for axis in "xyz"]))
                true.append(T[:3, 3])
    return measured, true


@pytest.mark.slow
def test_robots_before_four_gige_cameras(scene: Path, tmp_path: Path, fake_library: Path):
    """RMS of the positions below 2 mm, after alignment of the world frame; stamps within 0.2 ms of the cameras' own."""
    text = scene.read_text()
    scene.write_text(re.sub("sensor: mild", "sensor: clean", text))
    arena, epoch_ns = Scene.load(scene), time.time_ns() + round(START_S * 1e9)
    wave_end_ns = epoch_ns + round(arena.wave_s * 1e9)
    errors: dict[str, list[float]] = {name: [] for name in arena.cameras}
    with ExitStack() as stack:
        threads = []
        with ThreadPoolExecutor() as pool:
            started = [
                pool.submit(FakeCamera, fake_library, 20 + k, scene=(scene, name, epoch_ns))
                for k, name in enumerate(arena.cameras)
            ]
        fakes = [future.result() for future in started]
        for fake in fakes:
            stack.callback(fake.stop)
        for fake, (name, camera) in zip(fakes, arena.cameras.items(), strict=True):
            settings = SourceSettings(
                width=camera.width, height=camera.height, fps=FPS, exposure_us=camera.exposure_us
            )
            source = open_source(f"genicam:{fake.address}", settings)
            stack.callback(source.close)
            folders = {part: tmp_path / part / name for part in ("wand", "robots")}
            for folder in folders.values():
                folder.mkdir(parents=True)
            threads.append(
                threading.Thread(target=receive, args=(source, folders, wave_end_ns, errors[name]))
            )
            threads[-1].start()
            stack.callback(threads[-1].join, 30)
            stack.callback(source.close)  # before the thread is joined
        assert time.time_ns() < epoch_ns, "this machine is too loaded to start the cameras in time"
        threading.Event().wait((wave_end_ns - time.time_ns()) * 1e-9 + ROBOTS_S)
    measured, true = localize(scene, tmp_path, epoch_ns)
    assert len(true) > FPS * ROBOTS_S / 2
    rest = transform(rigid_motions(np.array(measured), np.array(true)), measured) - np.array(true)
    stamps = np.abs(np.concatenate(list(errors.values())))
    rms_mm = 1000 * np.sqrt((rest**2).sum(1).mean())
    print(
        f"{len(true)} poses, RMS {rms_mm:.2f} mm; {len(stamps)} stamps, largest error {stamps.max():.0f} us"
    )
    assert rms_mm < 2
    assert stamps.max() < 200
