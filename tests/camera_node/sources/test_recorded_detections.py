# SPDX-License-Identifier: BSD-3-Clause
"""observations.csv: a written file is read back unchanged, and an error names the line of an invalid row."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from camera_node.detection.roundels import Roundels
from camera_node.foundation.errors import CameraError, ConfigError
from camera_node.protocol.messages import Detections
from camera_node.sources.recorded_detections import detect_frames, read_observations, write_observations

CODE = 7


def message(camera: str, seq: int, t_ns: int, uv: np.ndarray, numbers: list[int]) -> Detections:
    roundels = Roundels.from_points(uv, 0.3, np.array(numbers, np.int32))
    roundels = replace(roundels, id_probability=np.where(np.array(numbers) == CODE, 1.0, np.nan))
    return Detections.pack(roundels, camera=camera, seq=seq, t_ns=t_ns, width=640, height=480)


def test_observations_are_read_as_they_were_written(tmp_path: Path):
    """Pixels are written with four decimals, which rounds them by up to half of the last one."""
    rng, path = np.random.default_rng(2), tmp_path / "observations.csv"
    sent = [
        message(camera, k, 10**18 + 33 * k + i, rng.uniform(0, 480, (3, 2)), [k, -1, CODE])
        for k in range(4)
        for i, camera in enumerate(("cam0", "north-2"))
    ]
    write_observations(path, sent)
    got = read_observations(path, {"cam0": (640, 480), "north-2": (640, 480)})
    assert [(m.camera, m.seq, m.t_ns, m.width) for m in got] == [
        (m.camera, m.seq, m.t_ns, m.width) for m in sorted(sent, key=lambda m: m.t_ns)
    ]
    for a, b in zip(got, sent, strict=True):
        np.testing.assert_allclose(a.unpack().uv, b.unpack().uv, atol=0.5001e-4)
        np.testing.assert_array_equal(a.unpack().id, b.unpack().id)
        np.testing.assert_array_equal(a.unpack().id_probability, b.unpack().id_probability)  # it is a code
        a.check()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("t_ns,camera,u\n1,a,2\n", "lacks the column v"),
        ("t_ns,camera,u,v\n", "holds no observations"),
        ("", "lacks the column"),
        ("t_ns,camera,u,v\n1,a,2,3\n1.5,a,2,3\n", "line 3"),
        ("t_ns,camera,u,v\n1,a,nan,3\n", "line 2"),
        ("t_ns,camera,u,v\n1,a,2\n", "line 2"),
        ("t_ns,camera,u,v\n-1,a,2,3\n", "line 2"),
        ("t_ns,camera,u,v\n1,,2,3\n", "line 2"),
        ("t_ns,camera,u,v,marker\n1,a,2,3,x\n", "line 2"),
        ("t_ns,camera,u,v,marker\n1,a,2,3,99999999999\n", "line 2"),
        ("t_ns,camera,u,v\n99999999999999999999,a,2,3\n", "line 2"),
        ("t_ns,camera,u,v,sigma_px\n1,a,2,3,0\n", "line 2"),
        ("frame,camera,u,v\n1,a,2,3\n", "give --fps"),
    ],
)
def test_an_error_names_the_file_and_the_line(tmp_path: Path, text: str, says: str):
    path = tmp_path / "observations.csv"
    path.write_text(text)
    with pytest.raises(ConfigError, match=says) as caught:
        read_observations(path)
    assert str(path) in str(caught.value)


def test_numbers_of_frames_and_standard_deviations_are_read(tmp_path: Path):
    (tmp_path / "o.csv").write_text("frame,camera,u,v,sigma_px\n30,a,2,3,0.5\n30,a,4,5,\n60,a,2,3,2\n")
    messages = read_observations(tmp_path / "o.csv", fps=30.0)
    assert [m.t_ns for m in messages] == [1_000_000_000, 2_000_000_000]
    np.testing.assert_allclose(
        messages[0].unpack().cov[:, [0, 1], [0, 1]], [[0.25, 0.25], [0.09, 0.09]], rtol=1e-6
    )
    (tmp_path / "o.csv").write_text("frame,camera,u,v\n0,a,2,3\nnan,a,2,3\n")
    with pytest.raises(ConfigError, match="line 3"):
        read_observations(tmp_path / "o.csv", fps=30.0)


def test_files_that_can_not_be_read_or_written_are_refused(tmp_path: Path):
    with pytest.raises(ConfigError, match="can't be read"):
        read_observations(tmp_path / "none.csv")
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match=r"bytes\.csv is not a text"):
        read_observations(tmp_path / "bytes.csv")
    with pytest.raises(ConfigError, match="can't be written"):
        write_observations(tmp_path / "no" / "o.csv", [])


def test_folders_without_cameras_are_refused(tmp_path: Path):
    with pytest.raises(CameraError, match="is not a folder"):
        detect_frames(tmp_path / "none")
    with pytest.raises(CameraError, match="no camera's folder"):
        detect_frames(tmp_path)


def test_a_recording_of_real_cameras_is_read(shared_data: Callable[[str], Path]):
    messages = read_observations(shared_data("webcams") / "wand_observations.csv")
    assert {m.camera for m in messages} == {"cam_0", "cam_1", "cam_2", "cam_3"}
    assert [m.t_ns for m in messages] == sorted(m.t_ns for m in messages)
    for m in messages:
        m.check()
