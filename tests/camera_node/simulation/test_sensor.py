# SPDX-License-Identifier: BSD-3-Clause
"""The simulated sensor: each stage does what it is named after."""

import numpy as np
import pytest

from camera_node.simulation.sensor import HARSH, MILD, Sensor, tone_curve

SIZE = (120, 160)


def flat(level: float) -> np.ndarray:
    return np.full(SIZE, level)


def expose(sensor: Sensor, light: np.ndarray) -> np.ndarray:
    return sensor.expose(light, np.random.default_rng(0))


def test_noise_has_the_stated_variance_at_every_level():
    """The sample variance of 19,200 pixels has a standard deviation of 1 %."""
    sensor = Sensor(noise=2.0, shot_noise=0.1)
    for level in (40.0, 120.0, 200.0):
        image = expose(sensor, flat(level))
        assert image.var() == pytest.approx(4 + 0.1 * level + 1 / 12, rel=0.05)
        assert image.mean() == pytest.approx(level, abs=5 * np.sqrt((4 + 0.1 * level) / image.size))


def test_light_falls_off_towards_the_corners_and_along_the_shading():
    falloff = Sensor(vignetting=0.4, shading=0.2).falloff((101, 101))
    assert falloff[50, 50] == pytest.approx(1)
    assert falloff[0, 0] == pytest.approx(0.6 * 0.9)
    assert falloff[50, 100] == pytest.approx(0.8 * 1.1)


@pytest.mark.parametrize("tone", ["linear", "gamma", "webcam"])
def test_a_tone_curve_rises_from_black_to_white(tone):
    curve = tone_curve(tone).astype(int)
    assert (curve[0], curve[255]) == (0, 255)
    assert (np.diff(curve) >= 0).all()


def test_light_beyond_the_scale_is_clipped():
    assert (expose(Sensor(noise=0.0, gain=2.0), flat(200.0)) == 255).all()


def test_a_mosaic_keeps_a_grey_surface_grey():
    image = expose(Sensor(noise=0.0, bayer=True), flat(100.0))
    assert np.abs(image[2:-2, 2:-2].astype(int) - 100).max() <= 1  # rounding of each colour


@pytest.mark.parametrize("sensor", [MILD, HARSH], ids=["mild", "harsh"])
def test_processing_correlates_the_noise(sensor: Sensor):
    """Neighbours of white noise have a correlation of 0 +- 0.007."""
    image = expose(sensor, flat(120.0))[:, 20:140].astype(float)
    image -= image.mean(axis=0)
    neighbours = np.corrcoef(image[:, :-1].ravel(), image[:, 1:].ravel())[0, 1]
    assert neighbours > 0.05


@pytest.mark.parametrize("wrong", [{"vignetting": 1.0}, {"jpeg": 0}, {"noise": -1.0}, {"gain": 0.0}])
def test_impossible_settings_are_refused(wrong):
    with pytest.raises(ValueError, match="must be in"):
        Sensor(**wrong)
