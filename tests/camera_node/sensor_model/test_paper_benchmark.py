# SPDX-License-Identifier: BSD-3-Clause
"""The benchmark `paper` at a tiny size: its images, its reference detector, its tables and its page."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from camera_node.sensor_model.visibility import detection_range
from camera_node.simulation.sensor import SENSORS
from tests.benchmarks.paper import comparison, distances, published, ranges, speed, threshold
from tests.benchmarks.paper.markers import markers
from tests.benchmarks.paper.reference import PaperDetector, locate
from tests.benchmarks.paper.report import PAGE, Section, table, update_page
from tests.benchmarks.paper.scenes import View, roundel, trace_print
from tests.camera_node.tracing import Sight, trace

LENS = published.paper_lens((640, 480))


def test_both_ray_tracers_agree():
    """This one samples points, the other one covers samples: edges differ by a fifth of a sample at most."""
    lens = comparison.LENS
    view = View(lens, (322.3, 238.1), 2.0, slant=0.7, turn=0.4)
    picture = trace_print(view, roundel(published.PATTERN))
    sight = Sight(picture.lens, tuple(picture.lens.project(view.position)[0]), float(view.position[2]), 0.14)
    other = trace(replace(sight.with_normal(view.normal), card=0.18 / 0.14))
    assert np.abs(picture.light - other).mean() < 0.5
    assert np.abs(picture.light - other).max() < 0.05 * 150


def test_the_reference_detector_measures_position_and_follows_the_threshold():
    """The moments of thresholded pixels are good for a quarter of a pixel and a hundredth of the distance."""
    view = View(LENS, (300.0, 220.0), 1.5, slant=0.3, turn=1.0)
    picture = trace_print(view, roundel(published.PATTERN))
    image = picture.expose(3.0, np.random.default_rng(2))
    detector = PaperDetector(theta=20.0)
    assert detector.detect(image) == []
    for _ in range(40):  # the threshold steps until the pattern is found
        if detector.detect(image):
            break
    found = detector.detect(image)
    assert len(found) == 1
    assert 100 < detector.theta < 130
    pose = locate(found[0], picture.lens, published.PATTERN.d_o)
    assert np.linalg.norm(picture.lens.project(pose.position_m) - picture.lens.project(view.position)) < 0.5
    assert np.linalg.norm(pose.position_m) == pytest.approx(1.5, rel=0.01)
    assert (pose.normals @ view.normal).max() > np.cos(0.05)


def test_every_marker_is_found_close_by_at_its_pose():
    for marker in markers():
        result = comparison.measure_point(marker, comparison.Condition(distance=1.5, slant=40.0), 2)
        assert result.recall == 1
        assert result.centre_px < 1  # the reference takes the ellipse's centre for the disc's
        assert result.distance_percent < 4
        assert result.normal_deg < 6
        assert comparison.measure_point(marker, comparison.Condition(distance=30.0), 1).recall == 0


def test_ours_is_more_precise_than_the_reference_and_the_distance_repeats_as_predicted():
    done, predicted = distances.measure_resolution((320, 240), 12)
    ours, reference = done["ours"].table(3.2), done["reference"].table(3.2)
    near = [x for x in ours if x in reference and 1 <= x <= 3]
    assert len(near) == 5
    ratios = [ours[x][1] / predicted[x] for x in near]
    # The standard deviation of 12 values has a relative error of 0.2, the mean of five 0.1.
    assert 0.7 < np.mean(ratios) < 1.5
    assert np.mean([ours[x][1] for x in near]) < np.mean([reference[x][1] for x in near])


@pytest.mark.slow  # ten seconds
def test_the_distance_of_a_tracked_pattern_repeats_in_a_hundred_images():
    """A disturbance that a fit assumes by chance must not persist: here the size was 0.45 % off from image 40 on.

    The standard deviation of 100 values has a relative error of 0.07; the prediction holds within 20 %.
    """
    done, predicted = distances.measure_resolution((480, 360), 100, published.DISTANCES[:4])
    for distance, (_, repeats) in done["ours"].table(3.5).items():
        assert repeats < 1.2 * (1 + 3 * 0.07) * predicted[distance]


def test_v_max_of_the_model_is_within_a_pixel_of_the_measured_range():
    """Of the pattern's size in the image."""
    lens, pattern = published.paper_lens((752, 480)), published.PATTERN
    ends = ranges.largest_distances(lens, pattern, 10)["ours"], detection_range(lens, pattern)[1]
    measured, predicted = (pattern.d_o * lens.fx / end for end in ends)
    assert measured == pytest.approx(predicted, abs=1.0)


@pytest.mark.ci
def test_detection_ends_where_the_threshold_says():
    found = threshold.share_found(threshold.Condition(), 13.0)
    assert found >= threshold.RECALL
    assert threshold.share_found(threshold.Condition(), 7.0) < 0.9


def test_a_page_gets_its_parts_and_keeps_the_rest(tmp_path: Path):
    page = tmp_path / "page.md"
    page.write_text("# Title\n<!-- begin a -->\nold\n<!-- end a -->\nlast\n")
    section = Section("Heading", "Text.", [table(("x", "y"), [(1, 2)])], ["y at 1"])
    update_page({"a": section}, page)
    update_page({"a": section}, page)
    text = page.read_text()
    assert text.startswith("# Title\n<!-- begin a -->\n## Heading\n")
    assert text.endswith("Not better than the paper: y at 1.\n<!-- end a -->\nlast\n")
    assert text.count("| 1 | 2 |") == 1
    with pytest.raises(ValueError, match="begin b"):
        update_page({"b": section}, page)


def test_the_page_has_every_row_of_the_papers_tables():
    text = PAGE.read_text()
    for resolution in published.RESOLUTIONS:
        name = f"{resolution[0]}x{resolution[1]}"
        for distance in published.table_3(resolution):
            assert f"| {name}, {distance:g} m |" in text
        for pattern in ("14 cm", *published.PATTERNS):
            assert f"| {name}, {pattern} |" in text
        assert text.count(f"| {name} |") >= 3


@pytest.mark.ci
def test_the_plot_is_drawn(tmp_path: Path):
    pytest.importorskip("matplotlib")
    result = comparison.Result(0.9, 0.01, 0.1, 1.0, 0.0)
    path = tmp_path / "plot.png"
    comparison.plot({"distance (m)": {"ours": {"1": result, "2": result}}}, path)
    assert path.read_bytes().startswith(b"\x89PNG")


def test_time_is_measured_of_detectors_that_find_the_pattern():
    images = speed.render((320, 240))
    assert all(t > 0 for t in speed.time_frames(images, 0.01))
    with pytest.raises(RuntimeError, match="does not find"):
        speed.time_frames([np.zeros_like(images[0])] * 2, 0.01)


def test_noise_of_sweeps_is_that_of_the_sensor():
    assert comparison.SWEEPS["noise (grey levels)"]["6"].sensor.noise == 6
    assert comparison.Condition().sensor == SENSORS["clean"]
