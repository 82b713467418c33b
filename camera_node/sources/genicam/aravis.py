# SPDX-License-Identifier: BSD-3-Clause
"""The functions of libaravis 0.8 that this driver uses, by its C interface.

Source: https://aravisproject.github.io/aravis/aravis-stable/. Functions that can fail take a GError** as their last
argument; `Aravis.call` adds it and raises `AravisError`.
"""

import ctypes
from ctypes import (
    POINTER,
    byref,
    c_bool,
    c_char_p,
    c_double,
    c_int,
    c_int64,
    c_size_t,
    c_uint,
    c_uint64,
    c_void_p,
)
from ctypes.util import find_library
from functools import cache
from typing import Any

from camera_node.foundation.errors import CameraError, ConfigError

LIBRARIES = {"aravis": "libaravis-0.8.so.0", "gobject": "libgobject-2.0.so.0", "glib": "libglib-2.0.so.0"}
NAMES = {"aravis": "aravis-0.8", "gobject": "gobject-2.0", "glib": "glib-2.0"}  # for other systems than Linux
OUT_INT64, OUT_DOUBLE, OUT_UINT64 = POINTER(c_int64), POINTER(c_double), POINTER(c_uint64)

# Without a GError**: result, arguments.
PLAIN: dict[str, tuple[Any, list[Any]]] = {
    "arv_update_device_list": (None, []),
    "arv_get_n_devices": (c_uint, []),
    "arv_get_device_id": (c_char_p, [c_uint]),
    "arv_get_device_vendor": (c_char_p, [c_uint]),
    "arv_get_device_model": (c_char_p, [c_uint]),
    "arv_get_device_serial_nbr": (c_char_p, [c_uint]),
    "arv_get_device_address": (c_char_p, [c_uint]),
    "arv_get_device_protocol": (c_char_p, [c_uint]),
    "arv_camera_get_device": (c_void_p, [c_void_p]),
    "arv_camera_is_gv_device": (c_bool, [c_void_p]),
    "arv_gv_device_is_controller": (c_bool, [c_void_p]),
    "arv_stream_push_buffer": (None, [c_void_p, c_void_p]),
    "arv_stream_timeout_pop_buffer": (c_void_p, [c_void_p, c_uint64]),
    "arv_gv_stream_get_statistics": (None, [c_void_p, OUT_UINT64, OUT_UINT64]),
    "arv_buffer_new_allocate": (c_void_p, [c_size_t]),
    "arv_buffer_get_status": (c_int, [c_void_p]),
    "arv_buffer_get_image_data": (c_void_p, [c_void_p, POINTER(c_size_t)]),
    "arv_buffer_get_image_width": (c_int, [c_void_p]),
    "arv_buffer_get_image_height": (c_int, [c_void_p]),
    "arv_buffer_get_timestamp": (c_uint64, [c_void_p]),
    "arv_device_get_feature": (c_void_p, [c_void_p, c_char_p]),
    "arv_gc_category_get_features": (c_void_p, [c_void_p]),
    "arv_gc_category_get_type": (c_size_t, []),
    "arv_gc_enumeration_get_type": (c_size_t, []),
    "arv_gc_boolean_get_type": (c_size_t, []),
    "arv_gc_command_get_type": (c_size_t, []),
    "arv_gc_float_get_type": (c_size_t, []),
    "arv_gc_integer_get_type": (c_size_t, []),
    "arv_gc_string_get_type": (c_size_t, []),
    "arv_gc_feature_node_get_actual_access_mode": (c_int, [c_void_p]),
}
# With a GError** as the last argument, which is not listed: result, arguments.
CHECKED: dict[str, tuple[Any, list[Any]]] = {
    "arv_camera_new": (c_void_p, [c_char_p]),
    "arv_camera_create_stream": (c_void_p, [c_void_p, c_void_p, c_void_p]),
    "arv_camera_get_payload": (c_uint, [c_void_p]),
    "arv_camera_start_acquisition": (None, [c_void_p]),
    "arv_camera_stop_acquisition": (None, [c_void_p]),
    "arv_camera_set_region": (None, [c_void_p, c_int, c_int, c_int, c_int]),
    "arv_camera_get_sensor_size": (None, [c_void_p, POINTER(c_int), POINTER(c_int)]),
    "arv_camera_set_frame_rate": (None, [c_void_p, c_double]),
    "arv_camera_get_frame_rate_bounds": (None, [c_void_p, OUT_DOUBLE, OUT_DOUBLE]),
    "arv_camera_is_exposure_auto_available": (c_bool, [c_void_p]),
    "arv_camera_set_exposure_time_auto": (None, [c_void_p, c_int]),
    "arv_camera_set_exposure_time": (None, [c_void_p, c_double]),
    "arv_camera_get_exposure_time": (c_double, [c_void_p]),
    "arv_camera_is_gain_auto_available": (c_bool, [c_void_p]),
    "arv_camera_set_gain_auto": (None, [c_void_p, c_int]),
    "arv_camera_set_gain": (None, [c_void_p, c_double]),
    "arv_camera_get_pixel_format_as_string": (c_char_p, [c_void_p]),
    "arv_camera_set_pixel_format_from_string": (None, [c_void_p, c_char_p]),
    "arv_camera_gv_auto_packet_size": (c_uint, [c_void_p]),
    "arv_device_is_feature_available": (c_bool, [c_void_p, c_char_p]),
    "arv_device_get_boolean_feature_value": (c_bool, [c_void_p, c_char_p]),
    "arv_device_set_boolean_feature_value": (None, [c_void_p, c_char_p, c_bool]),
    "arv_device_get_integer_feature_value": (c_int64, [c_void_p, c_char_p]),
    "arv_device_set_integer_feature_value": (None, [c_void_p, c_char_p, c_int64]),
    "arv_device_get_integer_feature_bounds": (None, [c_void_p, c_char_p, OUT_INT64, OUT_INT64]),
    "arv_device_get_integer_feature_increment": (c_int64, [c_void_p, c_char_p]),
    "arv_device_get_float_feature_value": (c_double, [c_void_p, c_char_p]),
    "arv_device_set_float_feature_value": (None, [c_void_p, c_char_p, c_double]),
    "arv_device_get_float_feature_bounds": (None, [c_void_p, c_char_p, OUT_DOUBLE, OUT_DOUBLE]),
    "arv_device_get_string_feature_value": (c_char_p, [c_void_p, c_char_p]),
    "arv_device_set_string_feature_value": (None, [c_void_p, c_char_p, c_char_p]),
    "arv_device_execute_command": (None, [c_void_p, c_char_p]),
    "arv_device_write_register": (c_bool, [c_void_p, c_uint64, c_uint]),
    "arv_device_read_memory": (c_bool, [c_void_p, c_uint64, c_uint, c_void_p]),
    "arv_gc_enumeration_dup_available_string_values": (POINTER(c_char_p), [c_void_p, POINTER(c_uint)]),
}


class AravisError(CameraError):
    """A camera or its network refuses a request."""


class _GError(ctypes.Structure):
    _fields_ = [("domain", c_uint), ("code", c_int), ("message", c_char_p)]


class _GSList(ctypes.Structure):
    _fields_ = [("data", c_char_p), ("next", c_void_p)]


class Aravis:
    """The loaded library. Raises ConfigError where it is not installed."""

    def __init__(self) -> None:
        self._aravis, self._gobject, self._glib = (_load(name) for name in LIBRARIES)
        self._gobject.g_object_unref.argtypes = [c_void_p]
        self._gobject.g_type_check_instance_is_a.argtypes = [c_void_p, c_size_t]
        self._glib.g_error_free.argtypes = self._glib.g_free.argtypes = [c_void_p]
        for name, (result, arguments) in PLAIN.items():
            function = getattr(self._aravis, name)
            function.restype, function.argtypes = result, arguments
        for name, (result, arguments) in CHECKED.items():
            function = getattr(self._aravis, name)
            function.restype, function.argtypes = result, [*arguments, POINTER(c_void_p)]

    def plain(self, name: str, *arguments: Any) -> Any:
        """Call a function that can't fail."""
        return getattr(self._aravis, name)(*arguments)

    def call(self, name: str, *arguments: Any) -> Any:
        """Call a function that can fail. Raises AravisError with the library's reason."""
        error = c_void_p()
        result = getattr(self._aravis, name)(*arguments, byref(error))
        if error:
            message = ctypes.cast(error, POINTER(_GError)).contents.message or b"unknown error"
            self._glib.g_error_free(error)
            raise AravisError(message.decode(errors="replace"))
        return result

    def text(self, name: str, *arguments: Any) -> str:
        """Call a function that can't fail and returns a text; empty for none."""
        return (self.plain(name, *arguments) or b"").decode(errors="replace")

    def release(self, instance: int) -> None:
        """Give back an object."""
        self._gobject.g_object_unref(instance)

    def is_a(self, node: int, kind: str) -> bool:
        """Whether a feature is of a kind: category, enumeration, boolean, command, float, integer or string."""
        type_id = self.plain(f"arv_gc_{kind}_get_type")
        return bool(self._gobject.g_type_check_instance_is_a(node, type_id))

    def features(self, category: int) -> list[str]:
        """The names in a category of features."""
        names, entry = [], self.plain("arv_gc_category_get_features", category)
        while entry:
            item = ctypes.cast(entry, POINTER(_GSList)).contents
            names.append((item.data or b"").decode(errors="replace"))
            entry = item.next
        return names

    def entries(self, enumeration: int) -> tuple[str, ...]:
        """The texts that an enumeration may have now. Raises AravisError."""
        count = c_uint()
        texts = self.call("arv_gc_enumeration_dup_available_string_values", enumeration, byref(count))
        found = tuple(texts[k].decode(errors="replace") for k in range(count.value))
        self._glib.g_free(texts)
        return found


@cache
def load_aravis() -> Aravis:
    """The library, loaded once. Raises ConfigError where it is not installed."""
    return Aravis()


def _load(name: str) -> ctypes.CDLL:
    try:
        return ctypes.CDLL(LIBRARIES[name])
    except OSError:
        pass
    if (found := find_library(NAMES[name])) is not None:
        return ctypes.CDLL(found)
    raise ConfigError(
        "GenICam cameras need the library Aravis 0.8: apt install libaravis-0.8-0 (macOS: brew install aravis)"
    )
