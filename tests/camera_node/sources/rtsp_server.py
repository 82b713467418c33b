# SPDX-License-Identifier: BSD-3-Clause
"""A camera that serves RTSP by GStreamer's server, in a process that can be killed and started on its port.

Each image contains its capture time, and is sent after a delay that varies.
"""

import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from camera_node.foundation.arrays import Grey
from tests.conftest import free_port
from tests.waiting import wait_for_port

PYTHON = "/usr/bin/python3"  # Debian's, which has GObject's bindings
PERIOD_S = 0.01
BLOCK_PX = 8  # of one bit, as JPEG's blocks
SHAPE = (64, 64)
CHECK = "import gi; gi.require_version('GstRtspServer', '1.0'); from gi.repository import GstRtspServer"
SERVER = """
import random, sys, threading, time
import gi
gi.require_version("Gst", "1.0")
gi.require_version("GstRtspServer", "1.0")
from gi.repository import GLib, Gst, GstRtspServer
port, period_ns, mean_delay_s = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])

def image_of(t_ns):
    rows = (t_ns.to_bytes(8, "big"))
    lines = (bytes(b for k in range(7, -1, -1) for b in [255 * (row >> k & 1)] * 8) * 8 for row in rows)
    return b"".join(lines)

def run(source):
    draw, begun_ns, k = random.Random(3), time.time_ns(), 0
    while True:
        captured_ns = begun_ns + k * period_ns
        leaves_ns = captured_ns + 20_000_000 + int(draw.expovariate(1 / mean_delay_s) * 1e9)
        time.sleep(max(0, leaves_ns - time.time_ns()) * 1e-9)
        buffer = Gst.Buffer.new_wrapped(image_of(captured_ns))
        buffer.pts, buffer.duration = k * period_ns, period_ns
        if source.emit("push-buffer", buffer) != Gst.FlowReturn.OK:
            return
        k += 1

def configure(factory, media):
    source = media.get_element().get_by_name("source")
    threading.Thread(target=run, args=(source,), daemon=True).start()

Gst.init(None)
server, factory = GstRtspServer.RTSPServer(), GstRtspServer.RTSPMediaFactory()
server.set_address("127.0.0.1")
server.set_service(port)
factory.set_launch("( appsrc name=source is-live=true format=time "
    "caps=video/x-raw,format=GRAY8,width=64,height=64,framerate=100/1 "
    "! videoconvert ! video/x-raw,format=I420 ! jpegenc quality=95 ! rtpjpegpay name=pay0 )")
factory.set_shared(True)
factory.connect("media-configure", configure)
server.get_mount_points().add_factory("/live", factory)
server.attach(None)
GLib.MainLoop().run()
"""


class RtspServer:
    """Serves images of `SHAPE` each 10 ms. Skips the test where Debian's packages are not installed.

    Args:
        mean_delay_s: of the part of the delay between capture and sending that varies, exponentially distributed.
    """

    def __init__(self, mean_delay_s: float) -> None:
        if not _is_installed():
            pytest.skip(
                "gir1.2-gst-rtsp-server-1.0, gstreamer1.0-plugins-good or python3-gi is not installed"
            )
        self._port = free_port()
        self._command = [PYTHON, "-c", SERVER, str(self._port), str(round(PERIOD_S * 1e9)), str(mean_delay_s)]
        self.url = f"rtsp://127.0.0.1:{self._port}/live"

    def __enter__(self) -> "RtspServer":
        self.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self.kill()

    def start(self) -> None:
        """Start the process, and wait until it listens."""
        self._process = subprocess.Popen(self._command)
        wait_for_port(self._port)

    def kill(self) -> None:
        """End the process at once, as a camera that loses its power does."""
        self._process.kill()
        self._process.wait()


def capture_time_ns(image: Grey) -> int:
    """The capture time that an image contains, Unix ns."""
    centres: Sequence[int] = range(BLOCK_PX // 2, SHAPE[0], BLOCK_PX)
    bits = image[np.ix_(centres, centres)] > 127
    return int.from_bytes(np.packbits(bits).tobytes(), "big")


def _is_installed() -> bool:
    if not Path(PYTHON).exists():
        return False
    return not subprocess.run([PYTHON, "-c", CHECK], capture_output=True, check=False, timeout=60).returncode
