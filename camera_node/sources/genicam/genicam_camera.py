# SPDX-License-Identifier: BSD-3-Clause
"""A GenICam camera without its stream: how it is found, its settings, features and clock."""

import contextlib
import time
from collections.abc import Callable, Mapping
from ctypes import byref, c_double, c_int, c_int64, c_ubyte
from dataclasses import dataclass

from camera_node.clocks.clock_offset import RoundTrip
from camera_node.foundation.errors import CameraAbsentError, CameraError
from camera_node.protocol.messages import ControlValue
from camera_node.sources.camera_description import Control, Mode
from camera_node.sources.frame import SourceSettings
from camera_node.sources.genicam.aravis import Aravis, AravisError, load_aravis
from camera_node.sources.genicam.pixel_formats import PixelFormat, parse_pixel_format

WRITABLE = (1, 2)  # ARV_GC_ACCESS_MODE_WO, _RW
PREFERRED = ("Mono8", "BayerRG8", "BayerGR8", "BayerGB8", "BayerBG8")
PACKET_SIZE = "GevSCPSPacketSize"
STANDARD = (PACKET_SIZE, "GevSCPD")  # Aravis knows them where the camera's file does not list them
AUTO_OFF = 0  # ARV_AUTO_OFF
# Bootstrap registers of GigE Vision: ticks a second, latch the time stamp, the latched time stamp.
TICKS, LATCH, LATCHED = 0x093C, 0x0944, 0x0948
LATCH_NOW = 2
DEPTH, MAX_FEATURES = 8, 4096  # of the tree of categories, which the camera's own file describes
KINDS = ("enumeration", "boolean", "command", "float", "integer", "string")


@dataclass(frozen=True, slots=True)
class FoundCamera:
    """A camera in Aravis's list; `id` opens it."""

    id: str
    vendor: str
    model: str
    serial: str
    address: str
    protocol: str

    @property
    def label(self) -> str:
        return f"{self.vendor} {self.model} {self.serial}"

    @property
    def source(self) -> str:
        """What `--source` takes to open it."""
        return f"genicam:{self.serial or self.id}"


def find_cameras() -> list[FoundCamera]:
    """The cameras of all networks and USB ports of this machine. Raises ConfigError where Aravis is missing."""
    aravis = load_aravis()
    aravis.plain("arv_update_device_list")
    functions = [
        f"arv_get_device_{name}" for name in ("id", "vendor", "model", "serial_nbr", "address", "protocol")
    ]
    count = aravis.plain("arv_get_n_devices")
    return [FoundCamera(*(aravis.text(function, k) for function in functions)) for k in range(count)]


def find_camera(text: str) -> FoundCamera:
    """A camera by serial number, Aravis's id or network address; the only one for an empty text.

    Raises:
        CameraAbsentError: there is none, or several.
        ConfigError: Aravis is missing.
    """
    cameras = find_cameras()
    matching = [c for c in cameras if not text or text in (c.serial, c.id, c.address)]
    if len(matching) == 1:
        return matching[0]
    present = "; ".join(f"{c.source} ({c.vendor} {c.model}, {c.address or c.protocol})" for c in cameras)
    if matching:
        raise CameraAbsentError(
            f"several GenICam cameras fit genicam:{text}; give a serial number: {present}"
        )
    advice = f"present: {present}" if cameras else "none answers; check power, cable and the firewall (UDP)"
    raise CameraAbsentError(f"no GenICam camera genicam:{text}; {advice}")


class GenicamCamera:
    """An open camera. Not safe to use from several threads at once.

    Attributes:
        name: in messages.
        is_network: it speaks GigE Vision.

    Raises:
        CameraAbsentError: it does not open.
    """

    def __init__(self, found: FoundCamera) -> None:
        self.name = f"{found.source} ({found.vendor} {found.model})"
        self._aravis: Aravis = load_aravis()
        try:
            self.handle: int = self._aravis.call("arv_camera_new", found.id.encode())
        except AravisError as error:
            raise CameraAbsentError(f"{self.name} does not open: {error}") from None
        self._device: int = self._aravis.plain("arv_camera_get_device", self.handle)
        self.is_network: bool = self._aravis.plain("arv_camera_is_gv_device", self.handle)

    def close(self) -> None:
        self._aravis.release(self.handle)

    def is_controlled(self) -> bool:
        """Whether this program may set the camera; False after a loss of the network's connection."""
        return not self.is_network or self._aravis.plain("arv_gv_device_is_controller", self._device)

    def configure(self, settings: SourceSettings, controls: Mapping[str, ControlValue]) -> None:
        """Apply all settings before the stream starts. Raises CameraError where the camera refuses one."""
        if settings.width is not None or settings.height is not None:
            size = (settings.width or -1, settings.height or -1)
            self._aravis.call("arv_camera_set_region", self.handle, -1, -1, *size)
        if settings.fps is not None:
            self._aravis.call("arv_camera_set_frame_rate", self.handle, settings.fps)
            with contextlib.suppress(AravisError):  # Aravis leaves the selector at the last kind of trigger
                self._set("TriggerSelector", "enumeration", "FrameStart")
        self.set_exposure(settings.exposure_us, settings.gain)
        if self.is_network and PACKET_SIZE not in controls:
            self._aravis.call("arv_camera_gv_auto_packet_size", self.handle)
        self.set_controls(controls)

    def set_exposure(self, exposure_us: float | None, gain: float | None) -> None:
        """Set exposure and gain, and turn off their automatic modes. Raises AravisError."""
        for name, value in (("exposure_time", exposure_us), ("gain", gain)):
            if value is None:
                continue
            automatic = f"{name.removesuffix('_time')}_auto"
            if self._aravis.call(f"arv_camera_is_{automatic}_available", self.handle):
                self._aravis.call(f"arv_camera_set_{name}_auto", self.handle, AUTO_OFF)
            self._aravis.call(f"arv_camera_set_{name}", self.handle, value)

    def exposure_us(self) -> float:
        """The exposure time now, microseconds; 0 where the camera does not state it."""
        try:
            return max(0.0, self._aravis.call("arv_camera_get_exposure_time", self.handle))
        except AravisError:
            return 0.0

    def pixel_format(self) -> PixelFormat:
        """The format of the images; a format that this program can't read is changed to one that it can.

        Raises:
            CameraError: the camera has none.
        """
        name = (self._aravis.call("arv_camera_get_pixel_format_as_string", self.handle) or b"").decode()
        if (known := parse_pixel_format(name)) is not None:
            return known
        offered = self._entries("PixelFormat")
        readable = [text for text in (*PREFERRED, *offered) if text in offered and parse_pixel_format(text)]
        if not readable or (known := parse_pixel_format(readable[0])) is None:
            raise CameraError(f"{self.name} has no readable pixel format, but {', '.join(offered)}")
        self._aravis.call("arv_camera_set_pixel_format_from_string", self.handle, readable[0].encode())
        return known

    def modes(self) -> tuple[Mode, ...]:
        """The full image in each pixel format, with the rate that the camera can have in its present settings."""
        width, height, low, high = c_int(), c_int(), c_double(), c_double()
        self._aravis.call("arv_camera_get_sensor_size", self.handle, byref(width), byref(height))
        try:
            self._aravis.call("arv_camera_get_frame_rate_bounds", self.handle, byref(low), byref(high))
        except AravisError:
            high.value = 0.0
        fps = high.value if 0 < high.value < 1e6 else None
        return tuple(Mode(width.value, height.value, name, fps) for name in self._entries("PixelFormat"))

    def controls(self) -> dict[str, Control]:
        """All features that can be set, by name."""
        found = {name: self._describe(name) for name in (*self._names("Root"), *STANDARD)}
        return {name: control for name, control in found.items() if control is not None}

    def set_controls(self, controls: Mapping[str, ControlValue]) -> None:
        """Set features by name, in order. Raises AravisError."""
        for name, value in controls.items():
            kind = self._kind(name)
            try:
                self._set(name, kind, value)
            except AravisError as error:
                raise AravisError(f"{self.name} refuses {name} = {value}: {error}") from None

    def is_triggered(self) -> bool:
        """Whether frames come only with a trigger, so that their absence is no fault."""
        try:
            mode = self._aravis.call("arv_device_get_string_feature_value", self._device, b"TriggerMode")
        except AravisError:
            return False
        return mode == b"On"

    def clock(self) -> Callable[[], RoundTrip] | None:
        """A function that reads the camera's clock; None where that is not possible."""
        ask = self._ask_gige if self.is_network else self._ask_usb
        try:
            first, second = ask(), ask()
        except AravisError:
            return None
        return ask if 0 < first.server_ns < second.server_ns else None

    def _ask_gige(self) -> RoundTrip:
        """A latch is a request of its own, so that its time lies between the request and its acknowledgement."""
        frequency = self._read_register(TICKS)
        sent_ns = time.monotonic_ns()
        self._aravis.call("arv_device_write_register", self._device, LATCH, LATCH_NOW)
        received_ns = time.monotonic_ns()
        ticks = self._read_register(LATCHED)
        return RoundTrip(sent_ns, ticks * 1_000_000_000 // max(frequency, 1), received_ns)

    def _ask_usb(self) -> RoundTrip:
        sent_ns = time.monotonic_ns()
        self._aravis.call("arv_device_execute_command", self._device, b"TimestampLatch")
        received_ns = time.monotonic_ns()
        value = self._aravis.call(
            "arv_device_get_integer_feature_value", self._device, b"TimestampLatchValue"
        )
        return RoundTrip(sent_ns, value, received_ns)

    def _read_register(self, address: int) -> int:
        data = (c_ubyte * 8)()
        self._aravis.call("arv_device_read_memory", self._device, address, len(data), data)
        return int.from_bytes(bytes(data), "big")

    def _names(self, category: str, depth: int = 0) -> list[str]:
        """The features of a category and of the categories in it, each once."""
        node = self._node(category)
        if not node or depth == DEPTH or not self._aravis.is_a(node, "category"):
            return [category] if node else []
        found = [name for entry in self._aravis.features(node) for name in self._names(entry, depth + 1)]
        return list(dict.fromkeys(found))[:MAX_FEATURES]

    def _node(self, name: str) -> int | None:
        return self._aravis.plain("arv_device_get_feature", self._device, name.encode())

    def _kind(self, name: str) -> str:
        node = self._node(name)
        return next((kind for kind in KINDS if node and self._aravis.is_a(node, kind)), "string")

    def _entries(self, name: str) -> tuple[str, ...]:
        node = self._node(name)
        return self._aravis.entries(node) if node and self._aravis.is_a(node, "enumeration") else ()

    def _describe(self, name: str) -> Control | None:
        """A feature with its bounds; None for one that can't be set now."""
        node = self._node(name)
        try:
            available = self._aravis.call("arv_device_is_feature_available", self._device, name.encode())
            mode = self._aravis.plain("arv_gc_feature_node_get_actual_access_mode", node) if node else 0
            return self._bounded(name, self._kind(name)) if available and mode in WRITABLE else None
        except AravisError:
            return None

    def _bounded(self, name: str, kind: str) -> Control:
        if kind == "command":
            return Control(name, "button")
        value = self._get(name, kind)
        if kind == "enumeration":
            return Control(name, "menu", entries=self._entries(name), value=value)
        if kind in ("integer", "float"):
            low, high, step = self._bounds(name, kind)
            return Control(name, "integer" if kind == "integer" else "float", low, high, step, value=value)
        return Control(name, "boolean" if kind == "boolean" else "text", value=value)

    def _bounds(self, name: str, kind: str) -> tuple[float | None, float | None, float | None]:
        number = c_int64 if kind == "integer" else c_double
        low, high = number(), number()
        try:
            self._aravis.call(
                f"arv_device_get_{kind}_feature_bounds", self._device, name.encode(), byref(low), byref(high)
            )
            step = None
            if kind == "integer":
                step = self._aravis.call(
                    "arv_device_get_integer_feature_increment", self._device, name.encode()
                )
        except AravisError:
            return None, None, None
        return low.value, high.value, step

    def _get(self, name: str, kind: str) -> ControlValue | None:
        stored = "string" if kind == "enumeration" else kind
        try:
            value = self._aravis.call(f"arv_device_get_{stored}_feature_value", self._device, name.encode())
        except AravisError:
            return None
        return value.decode(errors="replace") if isinstance(value, bytes) else value

    def _set(self, name: str, kind: str, value: ControlValue) -> None:
        if kind == "command":
            self._aravis.call("arv_device_execute_command", self._device, name.encode())
            return
        if kind == "enumeration" and not isinstance(value, str):
            kind = "integer"
        stored = "string" if kind == "enumeration" else kind
        converted = {"string": str(value).encode(), "boolean": bool(value)}
        if stored in ("integer", "float"):
            converted = {"integer": int(value), "float": float(value)}
        self._aravis.call(
            f"arv_device_set_{stored}_feature_value", self._device, name.encode(), converted[stored]
        )
