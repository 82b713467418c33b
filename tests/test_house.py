# SPDX-License-Identifier: BSD-3-Clause
"""The house: what may be imported from where, and that the native module is there."""

import subprocess
import sys

import numpy as np

from camera_node import _core


def test_the_native_module_computes():
    """Half of the pixels are 10 and half 200: the class means are those."""
    image = np.full((4, 6), 10, np.uint8)
    image[2:] = 200
    assert _core.class_means(image, 100) == (10.0, 200.0, 12)


def test_a_camera_node_imports_without_the_server_extra():
    """A Pi has no gtsam, viser or scipy: importing the node must not touch them."""
    code = (
        "import sys\n"
        "for name in ('gtsam', 'viser', 'scipy'): sys.modules[name] = None\n"
        "import camera_node.__main__, camera_node.device, camera_node.node, camera_node.observations\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
