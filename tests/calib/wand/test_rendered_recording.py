# SPDX-License-Identifier: BSD-3-Clause
"""The wand recording of tests/data, rendered and detected by this project, is calibrated as precisely as reported."""

from pathlib import Path

import numpy as np

from calib.rig.rig import load_rig
from calib.wand.calibrate import calibrate
from camera_node.foundation.config import load_yaml
from camera_node.geometry.body import Body
from camera_node.sources.recorded_detections import read_observations
from tests.calib.synthetic import assert_honest, camera_errors

ROOT = Path(__file__).resolve().parents[3]
RECORDING = ROOT / "tests" / "data" / "wand"


def test_the_rendered_recording_is_calibrated_as_precisely_as_reported():
    """All cameras are within four reported standard deviations, and the squared Mahalanobis error is below the 99.9 %
    quantile of chi-square. The file has ellipse centres without axes, which differ from the discs' own by up to
    D^2 / 8f = 0.15 px for a disc of D = 26 px and f = 566 px: 0.8 mm at 3 m, so 5 mm bounds the standard deviations."""
    rig, truth = load_rig(RECORDING / "rig.yaml"), load_rig(RECORDING / "truth.yaml")
    sizes = {name: (camera.width, camera.height) for name, camera in rig.cameras.items()}
    messages = read_observations(RECORDING / "observations.csv", sizes)
    result = calibrate(rig, load_yaml(ROOT / "configs" / "demo" / "wand.yaml", Body), messages)
    assert result.names == sorted(truth.cameras)
    sigma_mm = np.array([row.sigma_mm for row in result.report.cameras])
    assert sigma_mm.max() < 5
    off_m, _ = camera_errors(result.rig, truth)
    by_name = dict(zip(result.rig.placed(), 1e3 * off_m, strict=True))
    assert (np.array([by_name[name] for name in result.names]) < 4 * sigma_mm).all()
    assert_honest([(result, truth)])
    assert result.report.length_mean_mm is not None
    assert (
        abs(result.report.length_mean_mm) < 0.5
    )  # 0.15 px at 3 m are 0.8 mm at each end, averaged over poses
