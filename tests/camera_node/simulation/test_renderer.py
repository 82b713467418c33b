# SPDX-License-Identifier: BSD-3-Clause
"""Compares rendered pixels with projected outlines and their moments."""

import numpy as np
import pytest

from camera_node.geometry.pose import invert
from camera_node.simulation.discs import Disc, place_discs
from camera_node.simulation.floor import FLOOR
from camera_node.simulation.renderer import BLACK, WHITE, Renderer, covered_shares, vignette
from camera_node.simulation.scene import Scene
from camera_node.simulation.sensor import MILD
from tests.camera_node.scenes import CAMERA, DISC, load_disc, write_scene
from tests.conftest import ROOT

ROUNDING = 0.29  # standard deviation of a rounded grey level, sqrt(1/12)
TILTED = {"pitch_deg": {"mean": 25}, "roll_deg": {"mean": -20}, "z_m": {"mean": 0.3}}
LENSES = {
    "none": {},
    "barrel": {"distortion": [-0.25, 0.08, 0.002, -0.001, 0.0]},
    "fisheye": {"model": "fisheye", "distortion": [0.02, -0.01, 0.003, 0.0]},
}


def light_of(renderer: Renderer, t_s: float = 0.0, frame: int = 0) -> np.ndarray:
    """(h, w) grey levels minus the floor's, without vignetting."""
    return renderer.render(t_s, frame) / vignette(renderer.camera) - FLOOR


def moments(light: np.ndarray) -> tuple[float, np.ndarray]:
    """Sum and centroid (u, v) of an image."""
    v, u = np.indices(light.shape)
    return float(light.sum()), np.array([(light * u).sum(), (light * v).sum()]) / light.sum()


def true_moments(scene: Scene, t_s: float = 0.0) -> tuple[float, np.ndarray]:
    """The same from the outlines, projected through the lens and integrated by Green's theorem."""
    camera = scene.camera("cam0")
    body, T = scene.bodies_at(t_s)["disc"]
    disc = place_discs(body, invert(camera.T_world_cam) @ T)[0]
    total, first = 0.0, np.zeros(2)
    for radius, step in zip(disc.radii, (WHITE - FLOOR, BLACK - WHITE, WHITE - BLACK), strict=True):
        area, center = outline_moments(camera.project(circle(disc, radius)))
        total, first = total + step * area, first + step * area * center
    return total, first / total


def circle(disc: Disc, radius: float) -> np.ndarray:
    angles = np.linspace(0, 2 * np.pi, 2000, endpoint=False)
    return radius * np.column_stack([np.cos(angles), np.sin(angles)]) @ disc.T[:3, :2].T + disc.T[:3, 3]


def outline_moments(uv: np.ndarray) -> tuple[float, np.ndarray]:
    """Area and centroid of a polygon (N, 2)."""
    after = np.roll(uv, -1, axis=0)
    cross = uv[:, 0] * after[:, 1] - after[:, 0] * uv[:, 1]
    return abs(cross.sum()) / 2, ((uv + after) * cross[:, None]).sum(0) / (3 * cross.sum())


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (0.45, 0.3), (-0.5, -0.25), (0.5, -0.2)])
def test_area_and_centroid_of_a_disc_are_those_of_its_outline(tmp_path, lens, x, y):
    """Also through lenses with distortion.

    The floor is uniform, so all differences in light belong to the disc. Rounding to 8 bits adds 0.29 grey levels to
    each pixel, which over the disc's pixels (and with the vignette's 1 / 0.7) is `noise` on the sum, and `noise` times
    the spread over the sum on the centroid. The tolerance is 4 sigma, plus 0.2 % and 0.005 px for sub-sampled edges.
    """
    scene = load_disc(tmp_path, LENSES[lens], x_m={"mean": x}, y_m={"mean": y}, **TILTED)
    light = light_of(Renderer(scene, "cam0"))
    total, center = true_moments(scene)
    v, u = np.indices(light.shape)
    near = np.hypot(u - center[0], v - center[1]) < 40
    assert np.abs(light[~near]).max() <= 0.5 / 0.7
    got, where = moments(np.where(near, light, 0.0))
    noise = ROUNDING / 0.7 * np.sqrt(near.sum())
    assert got == pytest.approx(total, rel=0.002, abs=4 * noise)
    assert np.abs(where - center).max() < 0.005 + 4 * noise * 20 / abs(total)


def test_covered_shares_are_right_to_two_percent():
    """Shares of cells within a circle against counting 24 x 24 points in each cell, with an error of about 0.004."""
    rng = np.random.default_rng(3)
    for cu, cv in rng.uniform(-0.5, 0.5, (5, 2)):
        points = np.arange(-16 * 24, 16 * 24) / 24 + 0.5 / 24 - 0.5
        inside = np.hypot(points[None] - cu, points[:, None] - cv) < 9.3
        exact = inside.reshape(32, 24, 32, 24).mean((1, 3))
        fine = np.arange(-16 * 3 - 1, 16 * 3 + 1) / 3 + 0.5 / 3 - 0.5
        radius = np.hypot(fine[None] - cu, fine[:, None] - cv).astype(np.float32)
        parts = covered_shares(radius, (9.3,))[0].reshape(32, 3, 32, 3).mean((1, 3))
        assert np.abs(parts - exact).max() < 0.02
        assert parts.sum() == pytest.approx(np.pi * 9.3**2, rel=5e-4)


def test_the_same_scene_gives_the_same_pixels(tmp_path):
    """Two renderers of the same scene agree to the bit; another frame has different noise."""
    scene = load_disc(tmp_path, {"noise": 3.0})
    one, other = Renderer(scene, "cam0"), Renderer(scene, "cam0")
    assert (one.render(1.0, 5) == other.render(1.0, 5)).all()
    assert (one.render(1.0, 5) != other.render(1.0, 6)).mean() > 0.5


def test_noise_has_the_configured_standard_deviation(tmp_path):
    """Two frames differ by sqrt(2) sigma and rounding; 76,800 pixels determine that to 0.3 %, so 4 sigma are 1.1 %."""
    renderer = Renderer(load_disc(tmp_path, {"noise": 3.0}), "cam0")
    difference = renderer.render(0.0, 1).astype(float) - renderer.render(0.0, 2)
    assert difference.std() == pytest.approx(np.sqrt(2 * (3.0**2 + 1 / 12)), rel=0.011)


def test_the_nearer_roundel_hides_the_farther(tmp_path):
    """In any order of the bodies; inside the nearer card the image is that of this roundel alone."""
    high, low = {"z_m": {"mean": 0.5}, "y_m": {"mean": -0.1}}, {"z_m": {"mean": 0.1}}

    def render(**motions) -> np.ndarray:
        robots = dict.fromkeys(motions, DISC | {"inner_ratio": 0.5})
        return Renderer(Scene.load(write_scene(tmp_path, robots, motions)), "cam0").render(0.0)

    both, alone, under = render(a=low, b=high), render(b=high), render(a=low)
    assert (both == render(b=low, a=high)).all()
    inside = np.abs(alone.astype(float) - FLOOR) > 60
    assert (both[inside] == alone[inside]).mean() > 0.9
    assert (np.abs(both.astype(int) - under)[inside] > 10).mean() > 0.3
    assert (both != alone).any()


@pytest.mark.parametrize("pitch", [180, 120, 90])
def test_the_back_is_not_drawn(tmp_path, pitch):
    scene = load_disc(tmp_path, {"look_at_m": [0.01, 0.0, 0.0]}, pitch_deg={"mean": pitch}, z_m={"mean": 0.5})
    assert np.abs(light_of(Renderer(scene, "cam0"))).max() <= 0.5 / 0.7


def test_discs_are_clipped_at_the_image_border(tmp_path):
    """A smaller sensor behind the same lens has the same image, up to rounding, wherever a disc crosses its border."""
    narrow = {"width": 160, "height": 120, "cx": 78.3, "cy": 60.7}
    motion = {"x_m": {"amplitude": 0.7, "period_s": 1.0}, "y_m": {"amplitude": 0.5, "period_s": 1.6}}
    wide = Renderer(load_disc(tmp_path, {"distortion": [-0.1, 0.02, 0, 0]}, **motion), "cam0")
    cut = Renderer(load_disc(tmp_path, narrow | {"distortion": [-0.1, 0.02, 0, 0]}, **motion), "cam0")
    du, dv = (round(a - b) for a, b in ((CAMERA["cx"], 78.3), (CAMERA["cy"], 60.7)))
    for t_s in np.linspace(0, 1.6, 33):
        whole = light_of(wide, t_s)[dv : dv + 120, du : du + 160]
        assert np.abs(whole - light_of(cut, t_s)).max() < 2 * 0.5 / 0.7 + 0.1


def test_an_exposure_blurs_along_the_motion(tmp_path):
    """A speed of v px per exposure adds v^2 / 12 to the variance along the motion and does not move the centroid."""
    motion = {"x_m": {"amplitude": 0.5, "period_s": 2.0}, "z_m": {"mean": 0.2}}
    exposure = {"exposure_us": 30000.0, "fps": 20.0}
    sharp = light_of(Renderer(load_disc(tmp_path, exposure, **motion), "cam0"), 2.0)
    blurred = light_of(
        Renderer(load_disc(tmp_path, exposure | {"motion_samples": 16}, **motion), "cam0"), 2.0
    )
    speed_px = 0.5 * np.pi * 0.03 * CAMERA["fx"] / depth_of_motion()
    (sharp_at, sharp_var), (blurred_at, blurred_var) = spread(sharp), spread(blurred)
    assert blurred_var[0] - sharp_var[0] == pytest.approx(speed_px**2 / 12, rel=0.05)
    assert abs(blurred_var[1] - sharp_var[1]) < 0.05
    assert np.abs(blurred_at - sharp_at).max() < 0.01


@pytest.mark.parametrize("readout_us", [30000.0, -30000.0])
def test_a_rolling_shutter_reads_each_row_at_its_own_time(tmp_path, readout_us):
    """Each row is that of a global shutter at the row's time, up to rounding.

    The renderer blurs the image of the sheared disc, a lens the image of the disc at each time. At an oblique edge the
    blurs differ by s / 2 of their width, where s is the motion of the image from row to row: 0.07 px at most here, so
    3.5 %. A blurred edge of 187 grey levels changes by 187 phi(1) = 45 times that, 1.6 levels.
    """
    motion = {
        "x_m": {"amplitude": 0.35, "period_s": 1.1},
        "y_m": {"amplitude": 0.2, "period_s": 0.9, "phase_deg": 50},
        "z_m": {"mean": 0.5},
        "pitch_deg": {"amplitude": 30, "period_s": 1.3},
    }
    rolling = Renderer(load_disc(tmp_path, {"readout_us": readout_us}, **motion), "cam0")
    still = Renderer(load_disc(tmp_path, **motion), "cam0")
    image, at_once = light_of(rolling, 0.3), light_of(still, 0.3)
    rows = np.flatnonzero((np.abs(image) > 20).any(1))
    assert len(rows) > 30
    assert np.abs(image - at_once).max() > 50
    heights = rolling.camera.image_row(np.column_stack([rows, rows]))
    for row, height in zip(rows, heights, strict=True):
        expected = light_of(still, 0.3 + height * readout_us * 1e-6)
        assert np.abs(image[row] - expected[row]).max() < 2 * 0.5 / 0.7 + 1.6


def depth_of_motion() -> float:
    """Depth of the point (0, 0, 0.2) in the camera at (0, -0.6, 2) that looks at the origin."""
    return float(np.array([0.0, 0.6, -1.8]) @ np.array([0.0, 0.6, -2.0]) / np.hypot(0.6, 2.0))


def spread(light: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centroid and variance (2,) along u and v of the light of the only disc."""
    v, u = np.indices(light.shape)
    rows, columns = np.nonzero(np.abs(light) > 20)
    disc = np.where(np.hypot(u - columns.mean(), v - rows.mean()) < 32, light, 0.0)
    total, center = moments(disc)
    return center, np.array(
        [(disc * (u - center[0]) ** 2).sum(), (disc * (v - center[1]) ** 2).sum()]
    ) / total


def test_all_cameras_see_the_same_cluttered_floor():
    """Two cameras see the same grey levels at the same places of the floor.

    At 6,400 places, the correlation of unrelated floors is below 4 / sqrt(6400) = 0.05.
    """
    scene = Scene.load(ROOT / "configs" / "demo" / "scene.yaml")
    x, y = np.meshgrid(np.linspace(-1, 1, 80), np.linspace(-1, 1, 80))
    floor = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    levels = []
    for name in ("north", "east"):
        T = invert(scene.T_world_cam(name))
        u, v = np.round(scene.camera(name).project(floor @ T[:3, :3].T + T[:3, 3])).astype(int).T
        levels.append(Renderer(scene, name).render(scene.wave_s + 1, 0)[v.clip(0, 479), u.clip(0, 639)])
    assert np.corrcoef(levels)[0, 1] > 0.3
    assert np.std(levels[0]) > 15


def test_a_mild_sensor_shows_what_its_model_makes_of_the_light(tmp_path):
    """Without noise the picture of a clean camera, at the shares of light of both, through the model.

    The clean picture is rounded to 8 bits, which gamma spreads to at most two levels at these levels; JPEG moves flat
    areas by less than three.
    """
    clean = Renderer(load_disc(tmp_path, {"noise": 0.0}), "cam0")
    mild = Renderer(load_disc(tmp_path, {"sensor": "mild"}), "cam0")
    light = clean.render(0.0) / vignette(clean.camera) * vignette(mild.camera)
    expected = MILD.develop(light, np.zeros_like(light)).astype(float)
    shown = np.mean([mild.render(0.0, k) for k in range(20)], axis=0)
    assert np.median(np.abs(shown - expected)) < 2
    assert np.abs(shown.mean() - expected.mean()) < 2
    assert np.abs(shown - clean.render(0.0)).mean() > 20
