# SPDX-License-Identifier: BSD-3-Clause
"""Prints: rendered as a printer does, photographed from an angle, detected, and measured against their YAML."""

import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pypdfium2
import pytest

from calib.intrinsics.board import make_charuco_board, make_finder
from camera_node.commands.print import DIAMETER_M, Sheet
from camera_node.detection.detector import Detector
from camera_node.foundation.config import example_file, load_yaml
from camera_node.foundation.errors import ConfigError
from camera_node.geometry import codes
from camera_node.geometry.body import Body, PrintedWand
from camera_node.sources.recorded_frames import read_grey
from fusion.model.robots import load_robots

DPI = 300
PX_PER_MM = DPI / 25.4
TOLERANCE_MM = 0.1


def rasterize(pdf: Path) -> list[np.ndarray]:
    """The pages as grey images of 300 dots per inch; pixel (0, 0) is the paper's upper left corner."""
    with pypdfium2.PdfDocument(pdf) as document:
        pages = [page.render(scale=DPI / 72).to_numpy() for page in document]  # pyright: ignore[reportArgumentType]
    return [cv2.cvtColor(page, cv2.COLOR_BGR2GRAY) for page in pages]


def to_mm(uv: np.ndarray) -> np.ndarray:
    """Pixels of a raster, whose origin is the centre of a pixel, as millimetres on the paper."""
    return (np.asarray(uv) + 0.5) / PX_PER_MM


def exposed(raster: np.ndarray) -> np.ndarray:
    """The raster as a well exposed picture: paper at the scale's end may be brighter, which hides a part of its edges
    (axes of 189 px are 0.07 px off there in place of 0.04)."""
    return np.rint(0.8 * raster + 20).astype(np.uint8)


def scan(raster: np.ndarray, diameter_mm: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres (N, 2) and axes (N, 2) of the roundels, mm, and their ratios, from the raster at 200 px a diameter."""
    width = round(raster.shape[1] * min(1.0, 200 / (diameter_mm * PX_PER_MM)))
    scale = width / raster.shape[1]
    height = round(raster.shape[0] * scale)
    smaller = cv2.resize(raster, (width, height), interpolation=cv2.INTER_AREA)
    found = Detector().detect(exposed(smaller))
    factor = np.array([raster.shape[1] / width, raster.shape[0] / height]) / PX_PER_MM
    return (found.uv + 0.5) * factor, found.axes_px * factor.mean(), found.ratio


def photograph(raster: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A blurred, noisy picture of 1200 x 1000 pixels from 25 degrees beside the paper's normal.

    Returns:
        The picture, and the homography from its pixels to the raster's.
    """
    h, w = raster.shape
    focal, distance = 1200.0, 1.4 * max(h, w)
    tilt, turn = (cv2.Rodrigues(np.array(axis))[0] for axis in ([0.42, 0.1, 0.0], [0.0, 0.0, 0.3]))
    K = np.array([[focal, 0, 599.5], [0, focal, 499.5], [0, 0, 1]])
    centred = np.array([[1, 0, -w / 2], [0, 1, -h / 2], [0, 0, 1.0]])
    R = tilt @ turn
    H = K @ np.column_stack([R[:, 0], R[:, 1], [0, 0, distance]]) @ centred
    fine = np.diag([3.0, 3.0, 1.0]) @ np.array([[1, 0, 1 / 3], [0, 1, 1 / 3], [0, 0, 1]])
    sharp = cv2.warpPerspective(raster, fine @ H, (3600, 3000), flags=cv2.INTER_LINEAR, borderValue=150)
    small = cv2.GaussianBlur(cv2.resize(sharp, (1200, 1000), interpolation=cv2.INTER_AREA), (0, 0), 0.7)
    noise = np.random.default_rng(3).normal(0, 2, small.shape)
    return np.clip(0.8 * small + 20 + noise, 0, 255).astype(np.uint8), np.linalg.inv(H)


def measured(raster: np.ndarray) -> np.ndarray:
    """(N, 2) centres of the roundels on the paper, mm: of the discs, not of their ellipses in the photograph."""
    picture, H = photograph(raster)
    found = Detector().detect(picture)
    places = []
    for roundel in found:
        angles = np.linspace(0, 2 * np.pi, 60, endpoint=False)
        axes = np.array([np.cos(angles), np.sin(angles)]).T * roundel.axes_px / 2
        c, s = np.cos(roundel.angle_rad), np.sin(roundel.angle_rad)
        outline = roundel.uv + axes @ np.array([[c, s], [-s, c]])
        on_paper = cv2.perspectiveTransform(outline[None], H)[0]
        places.append(cv2.fitEllipse(on_paper.astype(np.float32))[0])
    return to_mm(np.array(places))


def assert_same_distances(found: np.ndarray, expected: np.ndarray) -> None:
    """The distances between points, sorted, agree within 0.1 mm; both are (N, 2) or (N, 3) mm."""

    def distances(points: np.ndarray) -> np.ndarray:
        i, j = np.triu_indices(len(points), 1)
        return np.sort(np.linalg.norm(points[i] - points[j], axis=1))

    assert len(found) == len(expected)
    assert np.abs(distances(found) - distances(expected)).max() < TOLERANCE_MM


def write(folder: Path, **options) -> Path:
    out = folder / "print.pdf"
    assert Sheet(out=out, **options).run() == 0
    return out


@pytest.mark.parametrize(("paper", "diameter"), [("a4", 0.05), ("letter", 0.06), ("a3", 0.12)])
def test_roundels_have_the_requested_size(tmp_path: Path, paper: str, diameter: float):
    """Every roundel of the raster has its diameter within 0.1 mm, and its ratio."""
    (raster,) = rasterize(write(tmp_path, what="roundels", paper=paper, diameter=diameter))
    centres, axes, ratios = scan(raster, 1e3 * diameter)
    assert len(centres) > 1
    assert np.abs(axes - 1e3 * diameter).max() < TOLERANCE_MM
    assert np.abs(ratios - 0.6).max() < 0.002


def test_codes_are_printed_as_their_words_state(tmp_path: Path):
    """The rings of a raster are black where the codes are, from the right on, counter-clockwise."""
    (raster,) = rasterize(write(tmp_path, what="roundels", codes="3,60-61", diameter=0.04))
    centres, _, _ = scan(raster, 40.0)
    assert len(centres) == 3
    angles = np.array([(k + 0.5) * codes.STEP for k in range(codes.SECTORS)])
    ring = 20 * (codes.INNER + codes.OUTER) / 2 * np.column_stack([np.cos(angles), -np.sin(angles)])
    for centre, code in zip(
        centres[np.lexsort((centres[:, 0], centres[:, 1].round()))], (3, 60, 61), strict=True
    ):
        u, v = (np.rint((centre + ring) * PX_PER_MM - 0.5).astype(int)).T
        due = codes.black_share(code, angles, np.full(len(angles), 1e-9)).round()
        assert np.array_equal(raster[v, u] < 128, due == 1)


@pytest.mark.parametrize("text", ["", "a", "1-2-3", "0", "98", "3-98"])
def test_codes_that_do_not_exist_are_refused(tmp_path: Path, text: str):
    with pytest.raises(ConfigError, match="--codes"):
        write(tmp_path, what="roundels", codes=text)


def test_a_wand_is_printed_with_codes_and_another_diameter(tmp_path: Path):
    out = write(tmp_path, what="wand", codes="5,3,9", diameter=0.05)
    wand = load_yaml(out.with_suffix(".yaml"), PrintedWand)
    assert (wand.codes, wand.diameter_m) == ((5, 3, 9), 0.05)
    with pytest.raises(ConfigError, match="--codes: 2 codes for 3 markers"):
        write(tmp_path, what="wand", codes="5,3")


def test_a_robot_is_printed_as_its_yaml_declares_it(tmp_path: Path):
    """One page with all roundels in place: photographed, their distances are those of the YAML that was written."""
    source = tmp_path / "robots.yaml"
    source.write_text(
        "robots: {cart: {diameter_m: 0.05, motion: ground, "
        "markers: [[0.08, 0, 0], [-0.07, 0.05, 0], [-0.04, -0.06, 0]]}}"
    )
    (raster,) = rasterize(write(tmp_path, what="robot", file=source))
    robot = load_robots(tmp_path / "print.yaml")["cart"]
    found = measured(raster)
    assert_same_distances(found, 1e3 * robot.points)
    x_up = found[np.argmin(found[:, 1])]  # the marker at x = 80 mm is nearest to the upper edge
    left = found[np.argmin(found[:, 0])]  # that at y = 50 mm is nearest to the left edge
    assert np.linalg.norm(x_up - left) == pytest.approx(np.hypot(150, 50), abs=TOLERANCE_MM)


def test_the_cards_of_a_cube_say_where_they_face(tmp_path: Path):
    """A card for each marker, with its place and its normal as printed text."""
    sheet = write(tmp_path, what="robot", file=example_file("robots_cube.yaml"))
    with pypdfium2.PdfDocument(sheet) as document:
        text = " ".join(page.get_textpage().get_text_bounded() for page in document)
    assert text.count("facing") == 18
    assert "cube 1: (70, -50, 140) mm facing (0, 0, 1)" in text
    assert load_robots(tmp_path / "print.yaml") == load_robots(example_file("robots_cube.yaml"))


@pytest.mark.parametrize("what", ["wand", "l-frame"])
def test_cards_have_the_size_of_their_yaml(tmp_path: Path, what: str):
    """A card for each roundel of a body that is larger than the paper; photographed, two of a page are measured."""
    pages = rasterize(write(tmp_path, what=what))
    body = load_yaml(tmp_path / "print.yaml", Body)
    found = [scan(page, 1e3 * body.diameter_m) for page in pages]
    assert sum(len(centres) for centres, *_ in found) == len(body.markers)
    for _, axes, _ in found:
        assert np.abs(axes - 1e3 * body.diameter_m).max() < TOLERANCE_MM
    assert_same_distances(measured(pages[0]), found[0][0])


def test_a_board_is_found_by_the_lens_calibration(tmp_path: Path):
    """With the text that is printed on it; all corners, in place within 0.1 mm, also from the photograph."""
    (raster,) = rasterize(write(tmp_path, what="board", columns=5, rows=7, square=0.03))
    spec = "charuco:5x7:0.03"
    expected = np.asarray(make_charuco_board(spec).getChessboardCorners())[:, :2] * 1e3
    picture, H = photograph(raster)
    corners = make_finder(spec).find(picture)
    assert corners is not None
    assert len(corners[0]) == len(expected) == 24
    on_paper = to_mm(cv2.perspectiveTransform(corners[0].reshape(1, -1, 2).astype(float), H)[0])
    assert np.abs((on_paper - on_paper[0]) - (expected - expected[0])).max() < 2 * TOLERANCE_MM
    assert_same_distances(on_paper[[0, 3, 20, 23]], expected[[0, 3, 20, 23]])


def test_the_ruler_is_true(tmp_path: Path):
    """100 mm from the first to the last tick, on the raster."""
    (raster,) = rasterize(write(tmp_path, what="board", columns=3, rows=3, square=0.02))
    row = raster[round((297 - 8) * PX_PER_MM)]  # through the ticks of each 10 mm
    dark = np.flatnonzero(row[: round(150 * PX_PER_MM)] < 200)
    assert (dark[-1] - dark[0]) / PX_PER_MM == pytest.approx(100, abs=0.25)  # the width of a line


def test_pdf_and_svg_are_the_same(tmp_path: Path):
    """A browser's image of the SVG, at 96 pixels per inch, shows the roundels of the PDF."""
    if (chromium := shutil.which("chromium")) is None:
        pytest.skip("chromium is not installed")
    sheet, picture = tmp_path / "sheet.svg", tmp_path / "sheet.png"
    assert Sheet("roundels", sheet, diameter=0.05).run() == 0
    flags = "--headless --no-sandbox --disable-gpu --disable-background-networking --window-size=794,1123"
    places = [f"--screenshot={picture}", f"--user-data-dir={tmp_path / 'profile'}", sheet.as_uri()]
    subprocess.run([chromium, *flags.split(), *places], check=True, timeout=60, capture_output=True)
    svg = Detector().detect(exposed(read_grey(picture)))
    (raster,) = rasterize(write(tmp_path, what="roundels", diameter=0.05))
    centres, axes, _ = scan(raster, 50)
    assert len(svg) == len(centres) == 12
    assert_same_distances((svg.uv + 0.5) * 25.4 / 96, centres)
    assert np.abs(svg.axes_px - axes * 96 / 25.4).max() < 0.25  # the browser draws curves as chords


def test_the_examples_have_one_size():
    """Print, wand, L-frame, robots and plan: what is printed by default is what the examples declare."""
    sizes = {load_yaml(example_file(name), Body).diameter_m for name in ("wand.yaml", "l.yaml")}
    sizes |= {robot.diameter_m for robot in load_robots(example_file("robots.yaml")).values()}
    assert sizes == {DIAMETER_M}
    assert f"diameter_m: {DIAMETER_M}" in example_file("plan.yaml").read_text()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"what": "roundels", "diameter": 0.5}, "643 mm does not fit on a4"),
        ({"what": "roundels", "diameter": -1.0}, "diameter_m is -1"),
        ({"what": "roundels", "paper": "a9"}, "choose one of a4"),
        ({"what": "roundels", "out": Path("x.png")}, "ends with .pdf or .svg"),
        ({"what": "wand", "out": Path("none/x.pdf")}, "none"),
        ({"what": "board", "square": 0.1}, "does not fit on a4"),
        ({"what": "board", "rows": 2}, "no board"),
        ({"what": "robot", "name": "rocket"}, "no robot 'rocket'; it has robot_a, robot_b"),
    ],
)
def test_impossible_prints_are_refused(options: dict, message: str, tmp_path: Path, monkeypatch):
    """One line, and nothing is written."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=message):
        Sheet(**options).run()
    assert not list(tmp_path.iterdir())


def test_a_yaml_that_exists_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """It may be the one that is printed."""
    path = tmp_path / "print.yaml"
    path.write_text(example_file("wand.yaml").read_text())
    before = path.read_text()
    write(tmp_path, what="wand", file=path)
    assert path.read_text() == before
    assert "is unchanged" in capsys.readouterr().out
