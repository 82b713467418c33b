# SPDX-License-Identifier: BSD-3-Clause
"""The house: what may be imported from where, and that the native module is there."""

import subprocess
import sys

from camera_node import _core


def test_the_native_module_computes():
    """A disc of 0.14 m whose major axis is 0.028 in the normalised image plane is 5 m away."""
    assert abs(_core.distance_by_principal_axis(0.14, 0.028) - 5.0) < 1e-12


def test_a_camera_node_imports_without_the_server_extra():
    """A Pi has no gtsam, viser or scipy: importing the node must not touch them."""
    code = (
        "import sys\n"
        "for name in ('gtsam', 'viser', 'scipy'): sys.modules[name] = None\n"
        "import camera_node.__main__, camera_node.sources.v4l2, camera_node.node.node\n"
        "import camera_node.sources.observations\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
