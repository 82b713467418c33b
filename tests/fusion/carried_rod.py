# SPDX-License-Identifier: BSD-3-Clause
"""A rod with two roundels that is carried through an arena, in which roundels as far apart hang on a wall.

As a program it publishes what the cameras of a running server see.
"""

import sys
import threading
from typing import cast

import numpy as np

from calib.rig.wand_file import WandBody
from camera_node.geometry.pose import rotation_from_vector
from camera_node.protocol.messages import encode
from camera_node.protocol.session import open_client
from fusion.model.robots import Robot
from tests.fusion.arena_process import in_real_time
from tests.fusion.serving import ARENA, KEYS
from tests.fusion.synthetic import PERIOD_NS, Arena, line

ROD = WandBody(diameter_m=0.1, markers=((0.0, 0.0, 0.0), (0.5, 0.0, 0.0)))
BACKGROUND = WandBody(diameter_m=0.1, markers=((0.0, 0.0, 0.0), (0.49, 0.0, 0.0), (0.0, 0.51, 0.0)))
LOOP_S = 4.0  # of the motion, which repeats
LOOP = round(LOOP_S * 1e9 / PERIOD_NS)  # frame sets
MAX_AGE_S = 0.1  # of a frame that is still sent


def carry(t: float) -> tuple[np.ndarray, np.ndarray]:
    """R and p of the rod, at t seconds: its middle moves around the arena, up and down."""
    a = 2 * np.pi * t / LOOP_S
    R = rotation_from_vector([0.3 * np.sin(a), 0.3 * np.cos(a), a])
    middle = [0.8 * np.cos(a), 0.8 * np.sin(a), 0.5 + 0.25 * np.sin(2 * a)]
    return R, np.array(middle) - R @ [0.25, 0.0, 0.0]


def arena() -> Arena:
    """The rod and the wall in the view of four cameras."""
    motions = {"rod": carry, "background": line((-0.2, -0.2, 0.1))}
    bodies = cast(
        dict[str, Robot], {"rod": ROD, "background": BACKGROUND}
    )  # no robot may have markers on a line
    return Arena(bodies, motions, ARENA.cameras, sigma_px=0.1)


def publish(endpoint: str) -> None:
    """Publish what the cameras see, in real time, until this process is killed."""
    messages = sorted(arena().messages(LOOP), key=lambda message: message.t_ns)
    with open_client([endpoint]) as session:
        print("publishing", flush=True)
        for message in in_real_time(messages, LOOP_S, threading.Event(), MAX_AGE_S):
            session.put(KEYS.detections(message.camera), encode(message))


if __name__ == "__main__":
    publish(sys.argv[1])
