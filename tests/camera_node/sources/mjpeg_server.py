# SPDX-License-Identifier: BSD-3-Clause
"""A camera that serves MJPEG over HTTP on loopback, with user and password, and delays that it notes."""

import base64
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np

USER, PASSWORD = "admin", "s3cret"
PERIOD_S, SHAPE = 0.02, (48, 64)


class MjpegServer:
    """Serves frames whose brightness is their number modulo 200; can be stopped and started on its port."""

    def __init__(self, port: int) -> None:
        self.port = port
        self.url = f"http://{USER}:{PASSWORD}@127.0.0.1:{port}/video"

    def __enter__(self) -> "MjpegServer":
        self.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()

    def start(self) -> None:
        """Listen, and serve each client in a thread."""
        ended = self._ended = threading.Event()

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                expected = base64.b64encode(f"{USER}:{PASSWORD}".encode()).decode()
                if self.headers.get("Authorization") != f"Basic {expected}":
                    self.send_response(401)
                    self.send_header("WWW-Authenticate", 'Basic realm="camera"')
                    self.end_headers()
                    return
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
                self.end_headers()
                begun_s, k = time.monotonic(), 0
                while not ended.wait(max(0.0, begun_s + k * PERIOD_S - time.monotonic())):
                    data = cv2.imencode(".jpg", np.full(SHAPE, 20 + k % 200, np.uint8))[1].tobytes()
                    head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                    try:
                        self.wfile.write(head.encode() + data + b"\r\n")
                    except OSError:
                        return
                    k += 1

            def log_message(self, format: str, *args: object) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", self.port), Handler)
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.02})
        self._thread.start()

    def stop(self) -> None:
        """End all streams and stop listening."""
        self._ended.set()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
