# SPDX-License-Identifier: BSD-3-Clause
"""The stream of images of an open GenICam camera."""

import contextlib
import ctypes
from ctypes import byref, c_size_t, c_ubyte, c_uint64
from dataclasses import dataclass

import numpy as np

from camera_node.foundation.arrays import Grey
from camera_node.sources.genicam.aravis import AravisError, load_aravis
from camera_node.sources.genicam.camera import GenicamCamera
from camera_node.sources.genicam.pixels import PixelFormat

N_BUFFERS = 8
COMPLETE = 0  # ARV_BUFFER_STATUS_SUCCESS
MAX_PAYLOAD = 256_000_000  # bytes of one image


@dataclass(frozen=True, slots=True)
class StampedImage:
    """An image (h, w) and the camera's own time stamp, ns."""

    image: Grey
    device_ns: int


class GenicamStream:
    """A running acquisition, until `close`.

    Attributes:
        incomplete: images of which packets are missing.

    Raises:
        AravisError: the camera refuses to start.
    """

    def __init__(self, camera: GenicamCamera, pixel_format: PixelFormat) -> None:
        self._aravis, self._camera, self._format = load_aravis(), camera, pixel_format
        self.incomplete = 0
        payload = self._aravis.call("arv_camera_get_payload", camera.handle)
        if not 0 < payload <= MAX_PAYLOAD:
            raise AravisError(f"{camera.name} states images of {payload} bytes")
        self._handle: int = self._aravis.call("arv_camera_create_stream", camera.handle, None, None)
        try:
            for _ in range(N_BUFFERS):
                buffer = self._aravis.plain("arv_buffer_new_allocate", payload)
                self._aravis.plain("arv_stream_push_buffer", self._handle, buffer)
            self._aravis.call("arv_camera_start_acquisition", camera.handle)
        except AravisError:
            self._aravis.release(self._handle)
            raise

    def pop(self, timeout_s: float) -> StampedImage | None:
        """The next complete image; None if none arrives in time. Raises AravisError after `close`."""
        if not self._handle:
            raise AravisError("the acquisition did not start again")
        buffer = self._aravis.plain("arv_stream_timeout_pop_buffer", self._handle, round(timeout_s * 1e6))
        if not buffer:
            return None
        try:
            return self._convert(buffer)
        finally:
            self._aravis.plain("arv_stream_push_buffer", self._handle, buffer)

    def lost_packets(self) -> int:
        """Packets that never arrived, since the start; 0 for USB."""
        if not (self._handle and self._camera.is_network):
            return 0
        resent, missing = c_uint64(), c_uint64()
        self._aravis.plain("arv_gv_stream_get_statistics", self._handle, byref(resent), byref(missing))
        return missing.value

    def close(self) -> None:
        """Stop the acquisition; also of a camera that no longer answers, and twice."""
        handle, self._handle = self._handle, 0
        if not handle:
            return
        if self._camera.is_controlled():  # otherwise each request takes seconds until it fails
            with contextlib.suppress(AravisError):
                self._aravis.call("arv_camera_stop_acquisition", self._camera.handle)
        self._aravis.release(handle)

    def _convert(self, buffer: int) -> StampedImage | None:
        if self._aravis.plain("arv_buffer_get_status", buffer) != COMPLETE:
            self.incomplete += 1
            return None
        size = c_size_t()
        address = self._aravis.plain("arv_buffer_get_image_data", buffer, byref(size))
        width = self._aravis.plain("arv_buffer_get_image_width", buffer)
        height = self._aravis.plain("arv_buffer_get_image_height", buffer)
        if not address or width <= 0 or height <= 0:
            self.incomplete += 1
            return None
        pixels = np.ctypeslib.as_array(ctypes.cast(address, ctypes.POINTER(c_ubyte)), (size.value,))
        try:
            image = self._format.to_grey(pixels, width, height)
        except ValueError:
            self.incomplete += 1
            return None
        return StampedImage(image, self._aravis.plain("arv_buffer_get_timestamp", buffer))
