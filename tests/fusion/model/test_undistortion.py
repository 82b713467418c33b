# SPDX-License-Identifier: BSD-3-Clause
"""The table of an inverse lens model compared with the lens model."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from camera_node.detection.roundels import Roundels
from camera_node.geometry.lens import Lens
from camera_node.geometry.outline import half_axes_of
from fusion import _core
from fusion.model.undistortion import (
    COV,
    MAX_CELLS,
    SCALE,
    TOLERANCE_PX,
    TOLERANCE_SCALE,
    XY,
    UndistortionTable,
    columns_of,
    table_of,
    undistort,
    undistort_exactly,
)
from tests.calib.synthetic import fit_ellipses

SIZE = {"width": 800, "height": 600, "cx": 402.0, "cy": 297.0}
LENSES = {
    "none": Lens(**SIZE, fx=650.0, fy=651.0),
    "usual": Lens(**SIZE, fx=650.0, fy=651.0, distortion=(-0.1, 0.02, 0.0003, -0.0002, 0.0)),
    "wide": Lens(**SIZE, fx=380.0, fy=381.0, distortion=(-0.2, 0.04, 0.001, -0.0005, -0.003)),
    "no inverse in the corners": Lens(**SIZE, fx=400.0, fy=400.0, distortion=(-0.45, 0.0, 0.0, 0.0)),
    "rational": Lens(**SIZE, fx=420.0, fy=421.0, distortion=(0.3, 0.1, 0.0, 0.0, 0.01, 0.6, 0.2, 0.02)),
    "fisheye": Lens(**SIZE, fx=270.0, fy=271.0, distortion=(-0.02, 0.005, -0.002, 0.0003), model="fisheye"),
}


def points(uv: np.ndarray) -> Roundels:
    """Centres (N, 2) of unknown size."""
    return Roundels.from_points(uv, 1.0)


def coordinates(lens: Lens, ellipses: Roundels) -> tuple[np.ndarray, np.ndarray]:
    """Undistorted centres (2, N), and Jacobians (2, 2, N) of pixels."""
    columns = undistort(lens, columns_of(ellipses))
    return columns[XY], columns[SCALE].reshape(2, 2, -1)


def in_cells(table: UndistortionTable, uv: np.ndarray) -> np.ndarray:
    """Undistorted points (2, N); NaN in empty cells."""
    columns = columns_of(points(uv))
    _core.undistort(table.coefficients, table.cell_px, 0.0, columns)
    return columns[XY]


def pixels(lens: Lens, n: int = 4000) -> np.ndarray:
    """Random pixels in the image and up to 40 px outside."""
    return np.random.default_rng(4).uniform([-40, -40], [lens.width + 40, lens.height + 40], (n, 2))


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_the_table_equals_the_lens_model(lens):
    """Nine points decide about a cell; between them the error can be twice as large."""
    uv = pixels(lens)
    xy, scale = coordinates(lens, points(uv))
    exact = lens.normalise(uv)
    known = np.isfinite(exact[:, 0])
    assert (np.isfinite(xy[0]) == known).all()
    rays = np.column_stack([exact[known], np.ones(known.sum())])
    by_xy = lens.project_with_jacobian(rays)[1][:, :, :2].transpose(1, 2, 0)
    off_px = np.einsum("ijn,jn->in", by_xy, xy[:, known] - exact[known].T)
    assert np.abs(off_px).max() < 2 * TOLERANCE_PX
    size = np.abs(by_xy).max((0, 1))
    assert (np.abs(scale[..., known] - by_xy) / size).max() < 2 * TOLERANCE_SCALE


@pytest.mark.parametrize("name", ["usual", "wide", "rational", "fisheye"])
def test_centres_are_those_of_undistorted_ellipses(name):
    """Against ellipses fitted to undistorted outlines, within 52 degrees of the axis. The shifts, up to 0.03 to 1 px,
    are of second order in the size; what remains is of fourth order, about a hundredth of them."""
    lens = LENSES[name]
    uv = np.random.default_rng(4).uniform([80, 80], [lens.width - 80, lens.height - 80], (900, 2))
    uv = uv[np.linalg.norm(lens.normalise(uv), axis=1) < np.tan(np.radians(52))][:300]
    angle = np.random.default_rng(5).uniform(-1.5, 1.5, 300)
    seen = replace(points(uv), axes_px=np.tile([24.0, 16.0], (300, 1)), angle_rad=angle)
    turn = 2 * np.pi * np.arange(32) / 32
    around = np.stack([np.cos(turn), np.sin(turn)])
    outline = uv[:, None] + (half_axes_of(seen.axes_px, seen.angle_rad) @ around).mT
    expected = fit_ellipses(lens.normalise(outline.reshape(-1, 2)).reshape(300, 32, 2))[0]
    xy, scale = coordinates(lens, seen)
    moved, off = (
        np.einsum("ijn,jn->ni", scale, a - b)
        for a, b in ((xy, coordinates(lens, points(uv))[0]), (xy, expected.T))
    )
    largest = np.linalg.norm(moved, axis=1).max()
    assert largest > 0.02
    assert np.linalg.norm(off, axis=1).max() < 0.02 * largest + TOLERANCE_PX
    exactly = undistort_exactly(lens, uv, half_axes_of(seen.axes_px, seen.angle_rad))[0]
    off = np.einsum("ijn,jn->ni", scale, exactly - xy)
    assert np.linalg.norm(off, axis=1).max() < 0.02 * largest + TOLERANCE_PX


@pytest.mark.parametrize("name", ["none", "usual", "wide", "rational"])
def test_the_table_covers_the_image_of_a_usual_lens(name):
    """Except for a cell at a corner where the lens has no inverse."""
    lens = LENSES[name]
    inside = pixels(lens)
    inside = inside[((inside > -0.5) & (inside < [lens.width - 0.5, lens.height - 0.5])).all(1)]
    assert np.isfinite(in_cells(table_of(lens), inside)[0]).mean() > 0.98


@settings(max_examples=30)
@given(st.lists(st.tuples(*[st.floats(-1e5, 1e5)] * 2, *[st.floats(width=32)] * 3), max_size=5))
def test_any_ellipse_is_accepted(ellipses):
    """Any centre and outline in a message gives coordinates or NaN; the outline moves the centre by 0.3 radii or less
    of what it is."""
    lens, columns = LENSES["usual"], np.array(ellipses).reshape(-1, 5)
    uv, axes, angle = columns[:, :2], columns[:, 2:4], columns[:, 4]
    xy, scale = coordinates(lens, replace(points(uv), axes_px=axes, angle_rad=angle))
    assert xy.shape == (2, len(uv))
    assert (np.isfinite(xy[0]) == np.isfinite(coordinates(lens, points(uv))[0][0])).all()
    assert (np.isfinite(scale).all((0, 1)) == np.isfinite(xy[0])).all()


def test_the_largest_image_has_a_small_table():
    """Before: 800 MB while the table of the largest image was made that a rig may contain."""
    lens = Lens(
        width=32768, height=32768, fx=3e4, fy=3e4, cx=16e3, cy=16e3, distortion=(-0.2, 0.05, 0.0, 0.0)
    )
    table = UndistortionTable(lens)
    assert table.coefficients.nbytes < 8 * 20 * (2 * MAX_CELLS)
    uv = np.random.default_rng(0).uniform(0, 32768, (200, 2))
    xy = in_cells(table, uv)
    known = np.isfinite(xy[0])
    assert known.mean() > 0.9
    np.testing.assert_allclose(xy[:, known].T, lens.normalise(uv[known]), atol=2 * TOLERANCE_PX / 3e4)


def test_no_detection_is_more_certain_than_the_table():
    """Whatever a camera claims: weights of 1e16 make the equations of a robot singular."""
    roundels = Roundels.from_points(np.array([[300.0, 200.0]]), 1e-8)
    columns = undistort(LENSES["usual"], columns_of(roundels))
    assert np.linalg.eigvalsh(columns[COV, 0].reshape(2, 2)).min() >= TOLERANCE_PX**2
