# SPDX-License-Identifier: BSD-3-Clause
"""Files in the layouts of other programs are read as they mean it, and what is written is read back as it was."""

import contextlib
import os
import re
import shlex
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
import scipy.io
import tyro

from calib.commands.calibrate_wand import Wand
from calib.commands.formats import FORMATS, ExportRig, FormatName, ImportData, make_rig
from calib.errors import CalibrationError
from calib.formats.data import ForeignData, PixelOrigin, with_coefficients
from calib.rig.camera import transform
from calib.rig.rig import Rig, load_rig, save_rig
from calib.rig.wand_file import WandBody
from calib.wand.calibrate import calibrate
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import invert, rotation_from_wxyz
from camera_node.sources.recorded_detections import read_observations
from tests.calib.foreign_layouts import write_caliscope
from tests.calib.stick import LENGTH_M, STICK, write_stick
from tests.calib.synthetic import camera_errors, ring, see_points

EASYWAND_PROFILE = (
    "1 2857 2336 1728 1168 864 1\n2 2857 2336 1728 1168 864 1\n3 4000 2336 1728 1168 864 1.01\n"
)
CLICKER_PROFILE = (
    "1 890.1 1280 720 640 360 1 -0.28 0.07 0.0004 -0.0001 0\n2 640 1280 720 640 360 1 0 0 0 0 0.1\n"
)
XYPTS = """pt1_cam1_X,pt1_cam1_Y,pt1_cam2_X,pt1_cam2_Y,pt2_cam1_X,pt2_cam1_Y,pt2_cam2_X,pt2_cam2_Y
NaN,NaN,NaN,NaN,NaN,NaN,NaN,NaN
101.0,201.0,301.5,401.5,111,211,NaN,NaN
1,1,1280,720,NaN,NaN,5,6
"""
CAMERA_ARRAY = """[cameras.0]
cam_id = 0
rotation_count = 0
error = 0.541
exposure = -8
grid_count = 39
ignore = false
fisheye = false
size = [1280, 720]
matrix = [[903.5, 0.0, 618.3], [0.0, 907.9, 394.2], [0.0, 0.0, 1.0]]
distortions = [-0.33, 0.046, -0.0043, 0.0041, 0.0666]
translation = [0.1, -0.2, 0.7]
rotation = [0.0, 0.0, 1.5707963267948966]

[cameras.1]
cam_id = 1
ignore = true
size = [640, 480]
matrix = "null"

[cameras.2]
cam_id = 2
ignore = false
size = [640, 480]
matrix = [[400.0, 0.0, 320.0], [0.0, 400.0, 240.0], [0.0, 0.0, 1.0]]
distortions = [0.01, 0.0, 0.0, 0.0]
fisheye = true
rotation = "null"
translation = "null"
"""
XY = """sync_index,port,frame_index,frame_time,point_id,img_loc_x,img_loc_y,obj_loc_x,obj_loc_y
7,0,12,1.25,0,10.5,20.5,0.05,0.05
7,0,12,1.25,3,11.5,21.5,0.05,0.2
8,2,14,1.31,3,400.0,300.0,,
"""
CAMCHAIN = """cam0:
  camera_model: pinhole
  intrinsics: [461.629, 460.152, 362.680, 246.049]
  distortion_model: radtan
  distortion_coeffs: [-0.277, 0.067, 0.0009, 0.0001]
  rostopic: /left/image_raw
  resolution: [752, 480]
  timeshift_cam_imu: -0.001
cam1:
  camera_model: pinhole
  intrinsics: [400.0, 401.0, 370.0, 240.0]
  distortion_model: equidistant
  distortion_coeffs: [0.01, 0.02, 0.0, 0.0]
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.11]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  rostopic: /right/image_raw
  resolution: [752, 480]
  timeshift_cam_imu: 0.002
"""
OPENCV = """%YAML:1.0
---
calibration_time: "Mon 01 Jan 2024"
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 5.2e+02, 0., 320.5, 0., 5.21e+02, 239.5, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -1.2e-01, 4.0e-02, 0., 0., 1.0e-03 ]
"""
CAMERA_INFO = """image_width: 640
image_height: 480
camera_name: head_left
camera_matrix: {rows: 3, cols: 3, data: [520.0, 0, 320.5, 0, 521.0, 239.5, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.12, 0.04, 0, 0, 0.001]}
"""


def read(name: FormatName, folder: Path, files: dict[str, str]) -> ForeignData:
    """Read files of the given contents."""
    for file, text in files.items():
        (folder / file).write_text(text)
    paths = [folder] if name == "multicamselfcal" else [folder / file for file in files]
    chosen = FORMATS[name]
    return chosen.read(paths, chosen.origin)


def read_folder(name: FormatName, folder: Path) -> ForeignData:
    """Read the files that are in a folder already."""
    chosen = FORMATS[name]
    return chosen.read([folder], chosen.origin)


def test_an_easywand_profile_has_a_row_for_each_camera(tmp_path: Path):
    cameras = read("easywand", tmp_path, {"profile.txt": EASYWAND_PROFILE}).cameras
    assert list(cameras) == ["cam1", "cam2", "cam3"]
    assert (cameras["cam3"].fx, cameras["cam3"].fy, cameras["cam3"].width) == (4000, 4040, 2336)
    assert cameras["cam1"].distortion == ()


@pytest.mark.parametrize(("name", "top"), [("dltdv", True), ("argus", False)])
def test_xypts_count_pixels_from_one_at_the_top_or_at_the_bottom(tmp_path: Path, name: FormatName, top: bool):
    """The corner pixel of the image is at (1, 1); of 720 rows, row 720 is the opposite one."""
    data = read(name, tmp_path, {"profile.txt": CLICKER_PROFILE, "xypts.csv": XYPTS})
    assert data.cameras["cam1"].distortion == (-0.28, 0.07, 0.0004, -0.0001, 0.0)
    points = data.points
    assert points is not None
    rows = list(
        zip(points.camera, points.frame.tolist(), points.marker.tolist(), points.uv.tolist(), strict=True)
    )
    assert ("cam1", 2, 0, [0.0, 0.0 if top else 719.0]) in rows
    assert ("cam2", 2, 0, [1279.0, 719.0 if top else 0.0]) in rows
    assert ("cam1", 1, 1, [110.0, 210.0 if top else 509.0]) in rows
    assert len(rows) == 6


def test_a_wand_table_without_names_has_the_cameras_of_the_profile(tmp_path: Path):
    table = "1,2,3,4,5,6,7,8\nNaN,NaN,13,14,15,16,NaN,NaN\n"
    points = read("easywand", tmp_path, {"profile.txt": CLICKER_PROFILE, "wandpts.csv": table}).points
    assert points is not None
    assert points.camera == ["cam1", "cam2", "cam2", "cam1", "cam1", "cam2"]
    assert points.marker.tolist() == [0, 0, 0, 1, 1, 1]
    assert points.uv[2].tolist() == [12.0, 13.0]


def test_multicamselfcal_input(tmp_path: Path):
    """Points of two cameras in three frames; IdMat marks one as not seen although points.dat has numbers."""
    files = {
        "points.dat": "1 2 NaN\n11 12 NaN\n1 1 NaN\n5.5 6.5 7.5\n15 16 17\n1 1 1\n",
        "IdMat.dat": "1 1 0\n1 0 1\n",
        "Res.dat": "800.0; 600.0;\n800.0; 600.0;\n",
        "basename1.rad": "K11 = 520.0;\nK12 = 0.0\nK13 = 402.0\nK22 = 522.0\nK23 = 297.0\n\nkc1 = -0.1\nkc2 = 0.03\n",
        "basename2.rad": "K11 = 530.0\nK12 = 0.0\nK13 = 402.0\nK22 = 532.0\nK23 = 297.0\n\nkc1 = -0.1\nkc4 = -0.01\n",
    }
    data = read("multicamselfcal", tmp_path, files)
    points = data.points
    assert points is not None
    assert points.camera == ["cam1", "cam1", "cam2", "cam2"]
    assert points.frame.tolist() == [0, 1, 0, 2]
    assert points.uv.tolist() == [[1, 11], [2, 12], [5.5, 15], [7.5, 17]]
    assert data.cameras["cam2"].parameters[:4] == pytest.approx([530, 532, 402, 297])
    assert data.cameras["cam2"].distortion == (-0.1, 0.0, 0.0, -0.01)


def write_selfcal_result(folder: Path) -> Rig:
    """Write a result folder of MultiCamSelfCal as flydra keeps it, in millimetres; return the true rig.

    Three cameras see 40 points, those of 10 only two of them. As in the real program, the calibration matrix of a
    projection is another than that of its lens: the projection maps to pixels that the lens undistorted.
    """
    cameras = {n: c.with_parameters(c.parameters[:8]) for n, c in ring(3).truth.cameras.items()}
    points = np.random.default_rng(2).uniform([-0.5, -0.5, 0.5], [0.5, 0.5, 1.2], (40, 3))
    larger = 1.1
    for k, camera in enumerate(cameras.values(), 1):
        K, mm = camera.K, np.diag([1e-3, 1e-3, 1e-3, 1.0])
        K_rad = np.array([[K[0, 0] / larger, 0, K[0, 2]], [0, K[1, 1] / larger, K[1, 2]], [0, 0, 1]])
        k1, k2, p1, p2 = camera.distortion
        kc = (k1 / larger**2, k2 / larger**4, p1 / larger, p2 / larger)
        entries = [f"K{i + 1}{j + 1} = {K_rad[i, j]:.16f}" for i in range(3) for j in range(3)]
        entries += ["", *(f"kc{i} = {value:.16f}" for i, value in enumerate(kc, 1))]
        (folder / f"basename{k}.rad").write_text("\n".join(entries) + "\n")
        P = -0.004 * K @ invert(camera.matrix())[:3] @ mm
        np.savetxt(folder / f"camera{k}.Pmat.cal", P)
        centre, toward = 1e3 * camera.matrix()[:3, 3], np.linalg.inv(P[:, :3])
        lines = [f"C{i} = {value:.6f} " for i, value in enumerate(centre, 1)] + [""]
        lines += [f"P{i + 1}{j + 1} = {toward[i, j]:.6f} " for i in range(3) for j in range(3)]
        (folder / f"basename{k}.cal").write_text("\n".join(lines) + "\n")
        seen = points[10:] if k == 3 else points
        one, uv = np.ones((len(seen), 1)), camera.project_world(seen)
        np.savetxt(folder / f"cam{k}.points4cal.dat", np.hstack([1e3 * seen, one, uv, one]), fmt="%16.7e")
    (folder / "Res.dat").write_text("800 600\n" * 3)
    (folder / "camera_order.txt").write_text("north_0\neast_0\nsouth_0\n")
    (folder / "calibration_units.txt").write_text("millimeters\n")
    return Rig(cameras=dict(zip(["north_0", "east_0", "south_0"], cameras.values(), strict=True)))


def test_a_result_of_multicamselfcal_has_lenses_poses_and_the_points_that_were_used(tmp_path: Path):
    truth = write_selfcal_result(tmp_path)
    data = read("multicamselfcal", tmp_path, {})
    assert list(data.cameras) == list(truth.cameras)
    for name, camera in truth.cameras.items():
        assert data.cameras[name].matrix() == pytest.approx(camera.matrix(), abs=1e-6)
        assert data.cameras[name].parameters == pytest.approx(camera.parameters, rel=1e-5, abs=1e-6)
    points = data.points
    assert points is not None
    assert np.bincount(points.frame).tolist() == [2] * 10 + [3] * 30
    assert not data.remarks


def test_the_rounded_projections_of_multicamselfcal_are_used_where_there_are_no_others(tmp_path: Path):
    """They have three digits: pixels of a millionth in 1/f."""
    truth = write_selfcal_result(tmp_path)
    for path in tmp_path.glob("*.Pmat.cal"):
        path.unlink()
    found = read("multicamselfcal", tmp_path, {}).cameras
    for name, camera in truth.cameras.items():
        at = [[0.1, -0.2, 0.9], [-0.3, 0.2, 0.6]]
        assert found[name].project_world(at) == pytest.approx(camera.project_world(at), abs=3.0)


def test_a_projection_that_no_lens_has_is_reported_with_its_error(tmp_path: Path):
    """The centre of distortion is 80 px from that of the projection."""
    write_selfcal_result(tmp_path)
    rad = tmp_path / "basename2.rad"
    shift = {"K13": 80.0, "K23": 60.0}
    lines = [line.split(" = ") for line in rad.read_text().splitlines()]
    lines = [f"{n[0]} = {float(n[1]) + shift.get(n[0], 0.0)}" if len(n) == 2 else "" for n in lines]
    rad.write_text("\n".join(lines).replace("kc1 = -", "kc1 = -1") + "\n")
    assert "camera 'east_0'" in read("multicamselfcal", tmp_path, {}).remarks[0]


def printed_command(capsys: pytest.CaptureFixture[str], data: ImportData) -> list[str]:
    """The words of the command that an import prints as the next one, after `roundel calibrate wand`."""
    capsys.readouterr()
    data.run()
    lines = capsys.readouterr().out.replace("\n", " ")
    return shlex.split(lines.split("next: ")[1])[3:]


@pytest.mark.parametrize("name", ["multicamselfcal", pytest.param("caliscope", marks=pytest.mark.ci)])
def test_the_printed_command_calibrates(tmp_path: Path, capsys, name: FormatName):
    """A result of MultiCamSelfCal, scaled by the distance of its cameras, and a board of Caliscope."""
    truth = write_selfcal_result(tmp_path) if name == "multicamselfcal" else write_caliscope_session(tmp_path)
    words = printed_command(capsys, ImportData(format=name, files=(tmp_path,), out=tmp_path / "in"))
    tyro.cli(Wand, args=words).run()
    back = load_rig(tmp_path / "in" / "calibrated.yaml")
    assert camera_errors(back, truth)[0].max() < 0.01


def test_caliscope_cameras_and_points(tmp_path: Path):
    """A camera rotated by a quarter turn about its axis; ignored cameras are left out, null means no pose."""
    data = read("caliscope", tmp_path, {"camera_array.toml": CAMERA_ARRAY, "xy.csv": XY})
    assert list(data.cameras) == ["cam0", "cam2"]
    seen = transform(invert(data.cameras["cam0"].matrix()), [[1.0, 0.0, 0.0]])
    assert seen[0] == pytest.approx([0.1, 0.8, 0.7])
    assert data.cameras["cam2"].model == "fisheye"
    assert data.cameras["cam2"].T_world_cam is None
    points = data.points
    assert points is not None
    assert points.t_s is not None
    assert points.t_s.tolist() == [1.25, 1.25, 1.31]
    assert points.marker.tolist() == [0, 3, 3]
    assert points.camera == ["cam0", "cam0", "cam2"]


def write_caliscope_session(folder: Path) -> Rig:
    """Write a session as Caliscope 0.11 writes it, and return the true rig: four cameras see a board of 3 x 4 corners,
    of which corner 5 is never detected, in 40 frames, with 0.1 px of noise."""
    truth, rng, messages = ring(4).truth, np.random.default_rng(3), []
    board = WandBody(markers=tuple((0.1 * (k % 3), 0.1 * (k // 3), 0.0) for k in range(12)))
    for seq in range(40):
        t_ns = 300_000_000 * seq
        at = transform(ring(4).wand_pose(1e-9 * t_ns), board.points)
        for name, camera in truth.cameras.items():
            uv = camera.project_world(at) + 0.1 * rng.standard_normal((12, 2))
            stamp = t_ns + 25_000_000_000
            messages.append(see_points(name, camera, uv, 0.1, np.arange(12) != 5, seq=seq, t_ns=stamp))
    write_caliscope(folder, truth, board, messages)
    (folder / "xyz_CHARUCO.csv").write_text(
        "sync_index,object_id,keypoint_id,x_coord,y_coord,z_coord,frame_time\n"
    )
    return truth


def test_a_session_of_caliscope_0_11_has_its_board_and_times(tmp_path: Path):
    """Corners are numbered without the one that no camera ever saw."""
    write_caliscope_session(tmp_path)
    data = read_folder("caliscope", tmp_path)
    assert data.wand is not None
    assert len(data.wand.markers) == 11
    assert data.wand.markers[5] == (0.0, 0.2, 0.0)
    assert data.points is not None
    assert data.points.t_s is not None
    assert data.points.t_s.min() == pytest.approx(25.0)
    (tmp_path / "timestamps.csv").unlink()
    untimed = read_folder("caliscope", tmp_path)
    assert untimed.points is not None
    assert untimed.points.t_s is None
    assert "have no time" in untimed.remarks[0]


def test_cameras_without_transforms_have_no_poses_whoever_wrote_them(tmp_path: Path):
    """Kalibr's radtan, and plumb_bob with k3, which TagSLAM writes."""
    parts = CAMCHAIN.split("  T_cn_cnm1:")
    bare = parts[0] + "  rostopic:" + parts[1].split("  rostopic:")[1]
    assert not any(c.T_world_cam for c in read("kalibr", tmp_path, {"a.yaml": bare}).cameras.values())
    tagslam = bare.replace("radtan", "plumb_bob").replace("0.0001]", "0.0001, 0.02]")
    cameras = read("kalibr", tmp_path, {"a.yaml": tagslam}).cameras
    assert cameras["left"].distortion == (-0.277, 0.067, 0.0009, 0.0001, 0.02)
    assert not any(camera.T_world_cam for camera in cameras.values())


def test_the_direction_of_y_is_an_option_of_the_command_line(tmp_path: Path):
    words = ["--format", "dltdv", "--out", str(tmp_path / "in"), "profile.txt"]
    origins = [
        tyro.cli(ImportData, args=[*more, *words]).origin(FORMATS[name])
        for name, more in (("dltdv", []), ("dltdv", ["--y-up"]), ("argus", []), ("argus", ["--y-down"]))
    ]
    assert [origin.y_up for origin in origins] == [False, True, True, False]
    with pytest.raises(ConfigError, match="exclude each other"):
        tyro.cli(ImportData, args=["--y-up", "--y-down", *words]).origin(FORMATS["dltdv"])


DATA = Path(os.environ.get("ROUNDEL_SHARED_DATA", "/work/shared/data"))


@pytest.mark.parametrize(
    ("name", "folder", "files", "cameras", "points"),
    [
        ("multicamselfcal", "multicamselfcal_result", [""], 5, 2122),
        ("caliscope", "caliscope_current", ["camera_array.toml", "xy_CHARUCO.csv"], 4, 2175),
        ("kalibr", "tag_wand", ["camchain.yaml"], 8, 0),
        ("kalibr", "tag_wand", ["camchain_tagslam.yaml"], 8, 0),
    ],
)
def test_recordings_of_others_open_unedited(name: FormatName, folder, files, cameras: int, points: int):
    if not (DATA / folder).is_dir():
        pytest.skip(f"{DATA / folder} is absent")
    chosen = FORMATS[name]
    data = chosen.read([DATA / folder / file for file in files], chosen.origin)
    assert (len(data.cameras), len(data.points or [])) == (cameras, points)


def test_kalibr_chain(tmp_path: Path):
    """cam1 is 0.11 m to the right of cam0, and its stamps are 3 ms early compared with those of cam0."""
    cameras = read("kalibr", tmp_path, {"camchain.yaml": CAMCHAIN}).cameras
    assert list(cameras) == ["left", "right"]
    assert cameras["right"].matrix()[:3, 3].tolist() == [0.11, 0, 0]
    assert cameras["right"].model == "fisheye"
    assert cameras["right"].time_offset_ms == pytest.approx(3.0)
    assert cameras["left"].distortion == (-0.277, 0.067, 0.0009, 0.0001)


def test_opencv_and_ros_files(tmp_path: Path):
    cameras = read("opencv", tmp_path, {"north.yaml": OPENCV, "other.yaml": CAMERA_INFO}).cameras
    assert list(cameras) == ["north", "head_left"]
    assert cameras["north"].parameters.tolist() == cameras["head_left"].parameters.tolist()
    assert cameras["north"].parameters.tolist() == [520, 521, 320.5, 239.5, -0.12, 0.04, 0, 0, 0.001]


ANIPOSE = """[cam_0]
name = "A"
size = [640, 480]
matrix = [[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]
distortions = [-0.1, 0.0, 0.0, 0.0, 0.0]
rotation = [0.0, 0.0, 0.0]
translation = [0.0, 0.0, 250.0]

[cam_1]
name = "B"
size = [640, 480]
matrix = [[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]
distortions = [-0.1, 0.0, 0.0, 0.0, 0.0]
rotation = [0.0, 1.5707963267948966, 0.0]
translation = [0.0, 0.0, 250.0]

[metadata]
adjusted = false
error = 0.21
"""
POSE2SIM = (
    ANIPOSE.replace("[cam_0]", "[int_cam1_img]")
    .replace('"A"', '"int_cam1_img"')
    .replace(
        "distortions = [-0.1, 0.0, 0.0, 0.0, 0.0]", "distortions = [-0.1, 0.0, 0.0, 0.0]\nfisheye = false"
    )
)


BROKEN = {
    "omnidirectional": ("argus", {"p.txt": "1 2 3 4 5\n"}, "omnidirectional"),
    "sba profile": ("argus", {"p.txt": " ".join(["1"] * 17)}, "no image sizes"),
    "no profile for rows from below": ("argus", {"x.csv": XYPTS}, "give the camera profile too"),
    "a table without names": ("dltdv", {"x.csv": "1,2,3,4\n"}, "give the camera profile too"),
    "an empty table": ("dltdv", {"x.csv": XYPTS.splitlines()[0] + "\nNaN\n"}, "has no points"),
    "words in a table": (
        "dltdv",
        {"x.csv": XYPTS.splitlines()[0] + "\nfoo\n"},
        "row 1: a cell is not a number",
    ),
    "a wrong column": (
        "dltdv",
        {"x.csv": "pt1_cam1_X,pt1_cam1_Z\n1,2\n"},
        "'pt1_cam1_Z' does not name a column",
    ),
    "two tables": ("dltdv", {"x.csv": XYPTS, "y.csv": XYPTS}, "import one after the other"),
    "lenses without sizes": (
        "multicamselfcal",
        {"a1.rad": "K11 = 1\nK13 = 1\nK22 = 1\nK23 = 1\n"},
        "Res.dat must have",
    ),
    "a lens without a centre": ("multicamselfcal", {"a1.rad": "K11 = 1\n", "Res.dat": "9 9\n"}, "lacks K13"),
    "a missing lens": (
        "multicamselfcal",
        {"points.dat": "1\n1\n1\n1\n1\n1\n", "a1.rad": "K11 = 1\n", "Res.dat": "9 9\n9 9\n"},
        "1 .rad files of 2 cameras",
    ),
    "an unknown unit": (
        "multicamselfcal",
        {"points.dat": "1\n1\n1\n", "calibration_units.txt": "cubits\n"},
        "the unit 'cubits' is unknown",
    ),
    "a used point without a pixel": (
        "multicamselfcal",
        {"cam1.points4cal.dat": "1 2 3 1 nan 5 1\n"},
        "7 finite numbers a row",
    ),
    "a direction matrix of zeros": (
        "multicamselfcal",
        {
            "c1.cal": "C1 = 0\nC2 = 0\nC3 = 0\n"
            + "".join(f"P{i}{j} = 0\n" for i in (1, 2, 3) for j in (1, 2, 3)),
            "Res.dat": "9 9\n",
        },
        "no projection",
    ),
    "rows of different lengths": ("multicamselfcal", {"points.dat": "1 2\n1\n"}, "not a matrix"),
    "a singular projection": (
        "multicamselfcal",
        {"c1.cal": "0 0 0 0\n" * 3, "Res.dat": "9 9\n"},
        "no projection",
    ),
    "no TOML": ("caliscope", {"a.toml": "[cameras"}, "not valid TOML"),
    "no cameras": ("caliscope", {"a.toml": "fps = 6\n"}, r"no tables \[cameras.0\]"),
    "no size": ("caliscope", {"a.toml": "[cameras.0]\nmatrix = [1]\n"}, "camera 0 has no usable"),
    "a time that is no number": (
        "caliscope",
        {"xy.csv": XY, "timestamps.csv": "sync_index,cam_id,frame_index,frame_time\n1,1,1,x\n"},
        "timestamps.csv, line 2: a value is not a number",
    ),
    "two tables of points": ("caliscope", {"xy.csv": XY, "xy_2.csv": XY}, "give one of them"),
    "other columns": ("caliscope", {"xy.csv": "frame,x,y\n1,2,3\n"}, "lacks the columns"),
    "another YAML": ("kalibr", {"a.yaml": "cameras: {}\n"}, "is it a camchain"),
    "an omni model": (
        "kalibr",
        {"a.yaml": "cam0: {camera_model: omni, distortion_model: radtan}\n"},
        "'omni'",
    ),
    "no rotation": (
        "kalibr",
        {"a.yaml": CAMCHAIN.replace("[1.0, 0.0, 0.0, -0.11]", "[9.0, 0.0, 0.0, 0.0]")},
        "rotation",
    ),
    "no matrix": ("opencv", {"a.yaml": "%YAML:1.0\n---\nimage_width: 3\n"}, "no 3 x 3 camera_matrix"),
    "no image size": ("opencv", {"a.yaml": OPENCV.replace("image_width: 640\n", "")}, "no image size"),
    "an impossible lens": ("opencv", {"a.yaml": OPENCV.replace("5.2e+02", "-5")}, "must be above 0"),
    "another distortion": ("opencv", {"a.yaml": CAMERA_INFO.replace("plumb_bob", "splined")}, "'splined'"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_file_is_refused_in_one_line(tmp_path: Path, case: str):
    name, files, fault = BROKEN[case]
    with pytest.raises((ConfigError, CalibrationError), match=fault) as caught:
        read(name, tmp_path, files)  # pyright: ignore[reportArgumentType]
    assert "\n" not in str(caught.value)


SAMPLES: dict[str, tuple[FormatName, str, str]] = {
    "profile": ("easywand", "profile.txt", CLICKER_PROFILE),
    "xypts": ("dltdv", "xypts.csv", XYPTS),
    "camera_array": ("caliscope", "a.toml", CAMERA_ARRAY),
    "xy": ("caliscope", "xy.csv", XY),
    "camchain": ("kalibr", "a.yaml", CAMCHAIN),
    "opencv": ("opencv", "a.yaml", OPENCV),
    "anipose": ("anipose", "a.toml", ANIPOSE),
    "colmap": ("colmap", "cameras.txt", "1 OPENCV 640 480 500 500 320 240 -0.1 0 0 0\n"),
    "points": ("multicamselfcal", "points.dat", "1 2\n11 12\n1 1\n5.5 6.5\n15 16\n1 1\n"),
}
MUTATIONS = ("nan", "inf", "-1", "1e308", "9" * 30, "", "[", "{}", "null", "x", ",", "\n", "\0", "true")


@pytest.mark.filterwarnings("ignore:overflow encountered:RuntimeWarning")
@pytest.mark.parametrize("sample", SAMPLES)
def test_a_mutated_file_is_read_or_refused(tmp_path: Path, sample: str):
    """Any other exception would be a traceback for the user."""
    name, file, text = SAMPLES[sample]
    rng = np.random.default_rng(7)
    for _ in range(150):
        words = re.split(r"([ ,\n\[\]:=])", text)
        for _ in range(rng.integers(1, 3)):
            words[rng.integers(len(words))] = MUTATIONS[rng.integers(len(MUTATIONS))]
        with contextlib.suppress(ConfigError, CalibrationError):
            data = read(name, tmp_path, {file: "".join(words)})
            if data.cameras:
                make_rig(data.cameras)
            if data.points is not None:
                data.points.write(tmp_path / "o.out")


@pytest.mark.parametrize("name", FORMATS)
def test_an_exported_rig_is_read_back(tmp_path: Path, name: FormatName):
    """Pixels of the markers in all cameras are equal; poses too, where the format has them: Argus has only DLT
    coefficients."""
    truth = ring(3).truth
    save_rig(truth, tmp_path / "rig.yaml")
    ExportRig(format=name, rig=tmp_path / "rig.yaml", out=tmp_path / "there").run()
    folder = tmp_path / "there"
    files = (
        (folder,) if name == "multicamselfcal" else tuple(p for p in folder.iterdir() if p.suffix != ".csv")
    )
    ImportData(format=name, files=files, out=tmp_path / "back").run()
    back = load_rig(tmp_path / "back" / "rig.yaml")
    assert len(back.cameras) == 3
    ahead = np.array([[0.3, -0.2, 1.0], [-0.4, 0.3, 1.0], [0.0, 0.0, 1.0]])
    by_focal = sorted(back.cameras.values(), key=lambda camera: camera.fx)
    for found, camera in zip(by_focal, truth.cameras.values(), strict=True):
        assert found.project(ahead) == pytest.approx(camera.project(ahead), abs=1e-3)
    if name in ("multicamselfcal", "caliscope", "anipose", "pose2sim", "colmap"):
        assert camera_errors(back, truth)[0].max() < 1e-9
        assert by_focal[1].matrix() == pytest.approx(truth.cameras["cam1"].matrix(), abs=1e-9)
    elif name in ("kalibr", "tagslam"):
        assert camera_errors(back, truth)[0].max() < 1e-9
    else:
        assert not back.placed()


def test_cameras_of_anipose_in_millimetres(tmp_path: Path):
    (tmp_path / "calibration.toml").write_text(ANIPOSE)
    files = (tmp_path / "calibration.toml",)
    ImportData(format="anipose", files=files, out=tmp_path / "in", unit_m=0.001).run()
    rig = load_rig(tmp_path / "in" / "rig.yaml")
    assert list(rig.cameras) == ["A", "B"]
    assert rig.cameras["A"].matrix()[:3, 3] == pytest.approx([0, 0, -0.25])
    assert rig.cameras["B"].matrix()[:3, 3] == pytest.approx([0.25, 0, 0])
    with pytest.raises(ConfigError, match="--unit-m is 0"):
        ImportData(format="anipose", files=files, out=tmp_path / "in", unit_m=0.0).run()


def test_cameras_of_pose2sim(tmp_path: Path):
    cameras = read("pose2sim", tmp_path, {"Calib.toml": POSE2SIM}).cameras
    assert list(cameras) == ["int_cam1_img", "B"]
    assert cameras["int_cam1_img"].distortion == (-0.1, 0, 0, 0)


TOPIC = """header:
  seq: 7
  stamp: {secs: 1, nsecs: 2}
  frame_id: "left"
height: 480
width: 640
distortion_model: "plumb_bob"
D: [-0.12, 0.04, 0.0, 0.0, 0.001]
K: [520.0, 0.0, 320.5, 0.0, 521.0, 239.5, 0.0, 0.0, 1.0]
R: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
P: [520.0, 0.0, 320.5, 0.0, 0.0, 521.0, 239.5, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
---
"""


def test_messages_that_ros_prints(tmp_path: Path):
    """ROS 1 has K and D, ROS 2 has k and d; --- follows each message."""
    second = TOPIC.replace("K:", "k:").replace("D:", "d:")
    cameras = read("ros", tmp_path, {"left.yaml": TOPIC, "right.yaml": second}).cameras
    for camera in cameras.values():
        assert camera.parameters.tolist() == [520, 521, 320.5, 239.5, -0.12, 0.04, 0, 0, 0.001]


def write_multiview(path: Path, truth: Rig, fisheye: int = 0) -> None:
    """Write what OpenCV 5's samples/python/multiview_calibration.py writes, with the images of a large board."""
    cameras, storage = list(truth.cameras.values()), cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    to_camera = [invert(camera.matrix()) @ cameras[0].matrix() for camera in cameras]
    storage.write("rvecs", np.array([cv2.Rodrigues(T[:3, :3])[0] for T in to_camera]))
    storage.write("distortions", np.array([[camera.distortion[:5]] for camera in cameras]))
    storage.write("Ks", np.array([camera.K for camera in cameras]))
    storage.write("Ts", np.array([T[:3, 3:] for T in to_camera]))
    storage.write("image_points", np.zeros((len(cameras), 200, 100, 2)))
    storage.write("is_fisheye", np.array([fisheye] * len(cameras)))
    storage.write("image_sizes", np.array([[camera.width, camera.height] for camera in cameras]))
    storage.write("cam_ids", ",".join(truth.cameras))
    storage.release()


def test_a_multiview_calibration_of_opencv(tmp_path: Path):
    """All cameras in one file, the first is the world; the images in it are more than what a camera file may have."""
    truth = ring(3).truth
    write_multiview(tmp_path / "multi.yaml", truth)
    back = make_rig(read("opencv", tmp_path, {"multi.yaml": (tmp_path / "multi.yaml").read_text()}).cameras)
    assert list(back.cameras) == list(truth.cameras)
    assert camera_errors(back, truth)[0].max() < 1e-9
    for name, camera in truth.cameras.items():
        assert back.cameras[name].parameters == pytest.approx(camera.parameters)
    broken = (tmp_path / "multi.yaml").read_text().replace("rvecs:", "turns:")
    with pytest.raises(ConfigError, match="lacks the matrix rvecs"):
        read("opencv", tmp_path, {"multi.yaml": broken})


def test_a_colmap_model_of_one_lens_for_two_images(tmp_path: Path):
    """An image without points has an empty line; a binary model is named with the command that converts it."""
    files = {
        "cameras.txt": "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n1 SIMPLE_RADIAL 640 480 500 320.5 240.5 -0.1\n",
        "images.txt": "# IMAGE_ID, ...\n1 1 0 0 0 0 0 2 1 north.png\n\n2 1 0 0 0 1 0 2 1 b/south.jpg\n3.5 4.5 -1\n",
    }
    data = read("colmap", tmp_path, files)
    assert list(data.cameras) == ["north", "south"]
    assert data.cameras["south"].matrix()[:3, 3].tolist() == [-1, 0, -2]
    assert data.cameras["north"].parameters.tolist() == [500, 500, 320, 240, -0.1, 0, 0, 0]
    assert "--unit-m" in data.remarks[0]
    (tmp_path / "bin").mkdir()
    with pytest.raises(ConfigError, match="colmap model_converter"):
        read_folder("colmap", tmp_path / "bin")


def write_easywand(folder: Path, y_up: bool, **changes) -> Rig:
    """Write a `.mat` as easyWand 5 saves it, and return the true rig."""
    write_stick(folder, "argus" if y_up else "easywand")
    cameras = {
        n: c.with_parameters([c.fx, c.fx, *c.parameters[2:]]) for n, c in ring(3).truth.cameras.items()
    }
    truth = Rig(cameras={f"cam{k}": camera for k, camera in enumerate(cameras.values(), 1)})
    FORMATS["argus"].write(truth, folder, PixelOrigin(1, y_up))
    placed = list(truth.cameras.values())
    data = {
        "version": 5.7,
        "wandLen": LENGTH_M,
        "imageWidth": np.array([c.width for c in placed], float),
        "imageHeight": np.array([c.height for c in placed], float),
        "focalLengths": np.array([c.fx for c in placed]),
        "ppts": np.array([[x for c in placed for x in (c.cx, c.cy)]]),
        "nlin": np.array([c.distortion for c in placed]),
        "wandPts": np.loadtxt(folder / "xypts.csv", delimiter=",", skiprows=1),
        "coefs": np.loadtxt(folder / "dltCoefs.csv", delimiter=","),
        "handles": np.zeros((0, 0)),
    }
    scipy.io.savemat(folder / "run_easyWandData.mat", {"easyWandData": {**data, **changes}})
    return truth


@pytest.mark.parametrize("y_up", [False, True])
def test_a_mat_file_of_easywand_has_everything_and_tells_the_direction_of_y(
    tmp_path: Path, capsys, y_up: bool
):
    truth = write_easywand(tmp_path, y_up)
    files = (tmp_path / "run_easyWandData.mat",)
    words = printed_command(capsys, ImportData(format="easywand", files=files, out=tmp_path / "in"))
    imported = load_rig(tmp_path / "in" / "rig.yaml")
    assert camera_errors(imported, truth)[0].max() < 1e-6
    tyro.cli(Wand, args=words).run()
    assert camera_errors(load_rig(tmp_path / "in" / "calibrated.yaml"), truth)[0].max() < 0.01


@pytest.mark.parametrize("y_up", [False, True])
def test_dlt_coefficients_tell_the_direction_of_y(tmp_path: Path, y_up: bool):
    truth = write_easywand(tmp_path, y_up)
    names = ("profile.txt", "xypts.csv", "dltCoefs.csv")
    with_coefficients = read("dltdv", tmp_path, {name: (tmp_path / name).read_text() for name in names})
    assert camera_errors(make_rig(with_coefficients.cameras), truth)[0].max() < 1e-6
    points = with_coefficients.points
    assert points is not None
    alone = read("argus" if y_up else "dltdv", tmp_path, {n: (tmp_path / n).read_text() for n in names[:2]})
    assert alone.points is not None
    assert points.uv == pytest.approx(alone.points.uv)
    assert bool(alone.remarks) is not y_up


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"focalLengths": np.array([1.0, 2.0])}, "not a result of easyWand|not of the same cameras"),
        ({"wandPts": np.full((4, 12), np.nan)}, "has no points"),
        ({"wandLen": np.nan}, "wandLen"),
        ({"imageWidth": np.array([np.nan] * 3)}, "NaN"),
    ],
)
def test_a_mat_file_with_impossible_values_is_refused(tmp_path: Path, changes, fault: str):
    write_easywand(tmp_path, False, **changes)
    chosen = FORMATS["easywand"]
    with pytest.raises((ConfigError, CalibrationError), match=fault):
        chosen.read([tmp_path / "run_easyWandData.mat"], chosen.origin)


def test_a_damaged_mat_file_is_refused(tmp_path: Path):
    write_easywand(tmp_path, False)
    path, chosen = tmp_path / "run_easyWandData.mat", FORMATS["easywand"]
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    for _ in range(60):
        damaged = bytearray(whole)
        for at in rng.integers(128, len(whole), 4):
            damaged[at] = rng.integers(256)
        path.write_bytes(bytes(damaged[: rng.integers(200, len(whole))]))
        with contextlib.suppress(ConfigError, CalibrationError):
            chosen.read([path], chosen.origin)


def test_exported_opencv_files_are_read_by_opencv(tmp_path: Path):
    truth = ring(2).truth
    FORMATS["opencv"].write(truth, tmp_path, FORMATS["opencv"].origin)
    storage = cv2.FileStorage(str(tmp_path / "cam1.yaml"), cv2.FILE_STORAGE_READ)
    K, D, R, T = (storage.getNode(n).mat() for n in ("camera_matrix", "distortion_coefficients", "R", "T"))
    uv = cv2.projectPoints(np.array([[0.1, 0.2, 0.9]]), cv2.Rodrigues(R)[0], T, K, D)[0].ravel()
    assert uv == pytest.approx(truth.cameras["cam1"].project_world([[0.1, 0.2, 0.9]])[0])


def test_exported_dlt_coefficients_give_the_undistorted_pixels_of_argus(tmp_path: Path):
    """u = (L1 x + L2 y + L3 z + L4) / (L9 x + L10 y + L11 z + 1), and the same for v; rows from below, from 1."""
    truth = ring(2).truth
    plain = Rig(
        cameras={
            n: c.with_parameters(c.parameters * ([1.0] * 4 + [0.0] * 5)) for n, c in truth.cameras.items()
        }
    )
    FORMATS["argus"].write(plain, tmp_path, FORMATS["argus"].origin)
    L = np.loadtxt(tmp_path / "dltCoefs.csv", delimiter=",")
    assert L.shape == (11, 2)
    point = np.array([0.2, -0.1, 0.8, 1.0])
    for k, camera in enumerate(plain.cameras.values()):
        scale = L[8:, k] @ point[:3] + 1
        uv = camera.project_world(point[None, :3])[0]
        expected = [uv[0] + 1, camera.height - uv[1]]
        assert [L[:4, k] @ point / scale, L[4:8, k] @ point / scale] == pytest.approx(expected)


def test_exported_colmap_model(tmp_path: Path):
    """The centre of the top-left pixel is (0.5, 0.5), and poses take the world into the camera."""
    truth = ring(2).truth
    FORMATS["colmap"].write(truth, tmp_path, FORMATS["colmap"].origin)
    camera = truth.cameras["cam1"]
    words = (tmp_path / "cameras.txt").read_text().splitlines()[2].split()
    assert words[:4] == ["2", "OPENCV", "800", "600"]
    assert [float(w) for w in words[4:8]] == pytest.approx(
        [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5]
    )
    pose = (tmp_path / "images.txt").read_text().splitlines()[3].split()
    assert pose[8:] == ["2", "cam1.png"]
    q, t = np.array(pose[1:5], float), np.array(pose[5:8], float)
    point = np.array([0.1, 0.2, 0.3])
    assert rotation_from_wxyz(q) @ point + t == pytest.approx(transform(invert(camera.matrix()), point)[0])


def test_a_lens_with_k3_is_written_with_four_coefficients_where_that_is_near_enough():
    lens = Lens(
        width=800, height=600, fx=500, fy=501, cx=400, cy=300, distortion=(-0.28, 0.1, 1e-4, 1e-4, -0.001)
    )
    shorter, off = with_coefficients("cam0", lens, 4)
    assert len(shorter.distortion) == 4
    assert 0 < off < 0.2
    wide = msgspec.structs.replace(lens, fx=300.0, fy=300.0, distortion=(-0.2, 0.05, 0.0, 0.0, 0.1))
    with pytest.raises(CalibrationError, match="camera 'cam0': its lens can't be written with 4"):
        with_coefficients("cam0", wide, 4)


def test_imported_points_calibrate_a_rig(tmp_path: Path):
    """A stick before three cameras in the tables of DLTdv, with numbers of frames and no diameter: as recorded."""
    truth = ring(3).truth
    write_stick(tmp_path, "dltdv")
    table = tmp_path / "xypts.csv"
    ImportData(format="dltdv", files=(table, tmp_path / "profile.txt"), out=tmp_path).run()
    rig = load_rig(tmp_path / "rig.yaml")
    messages = read_observations(tmp_path / "observations.csv", fps=100.0)
    messages = [msgspec.structs.replace(m, width=800, height=600) for m in messages]
    result = calibrate(rig, STICK, messages, synchronous=True)
    there = Rig(cameras={f"cam{k + 1}": camera for k, camera in enumerate(truth.cameras.values())})
    assert camera_errors(result.rig, there)[0].max() < 0.01
