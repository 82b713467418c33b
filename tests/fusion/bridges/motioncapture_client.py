# SPDX-License-Identifier: BSD-3-Clause
"""A program that reads trackers by libmotioncapture, which contains VRPN's own C++ client: JSON lines on stdout.

Its calls block and never end, so it runs in a process of its own.
"""

import json
import sys

import motioncapture


def main() -> None:
    """Print each frame as {name: [x, y, z, qw, qx, qy, qz]}."""
    client = motioncapture.connect("vrpn", {"hostname": sys.argv[1]})
    while True:
        client.waitForNextFrame()
        bodies = client.rigidBodies
        rows = {
            name: [*b.position.tolist(), b.rotation.w, b.rotation.x, b.rotation.y, b.rotation.z]
            for name, b in bodies.items()
        }
        if rows:
            print(json.dumps(rows), flush=True)


if __name__ == "__main__":
    main()
