# SPDX-License-Identifier: BSD-3-Clause
"""How a program runs as a service: it ends on signals, and reports its state to systemd."""

import contextlib
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence


class ServiceManager:
    """Reports readiness, state and progress to systemd as sd_notify(3) describes; silent where systemd did not start
    this program. A context manager that reports the end of the service.

    A program that stops reporting progress for `WatchdogSec` is restarted.
    """

    def __init__(self) -> None:
        self._address = os.environ.get("NOTIFY_SOCKET", "")
        watchdog_us = os.environ.get("WATCHDOG_USEC", "")
        is_own = os.environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self._period_s = int(watchdog_us) * 1e-6 / 4 if watchdog_us.isdecimal() and is_own else 0.0
        self._next_s = 0.0

    def __enter__(self) -> "ServiceManager":
        return self

    def __exit__(self, *exception: object) -> None:
        self._send("STOPPING=1")

    def ready(self) -> None:
        """Report that the service works: others may start to use it."""
        self._send("READY=1")

    def report(self, state: str) -> None:
        """Report the state in one line, for `systemctl status`."""
        self._send(f"STATUS={' '.join(state.split())}")

    def progress(self) -> None:
        """Report progress, at most four times in the time that the watchdog allows; called by the program's loop."""
        if self._period_s and time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + self._period_s
            self._send("WATCHDOG=1")

    def _send(self, message: str) -> None:
        if not self._address:
            return
        address = "\0" + self._address[1:] if self._address.startswith("@") else self._address
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as datagram:
            datagram.setblocking(False)  # the service does not wait for its manager
            datagram.sendto(message.encode(), address)


class StopEvent(threading.Event):
    """An event that ends a program, also where it waits for something else, such as a camera's next frame."""

    def __init__(self) -> None:
        super().__init__()
        self._lock = threading.Lock()
        self._closes: list[Callable[[], object]] = []

    def set(self) -> None:
        """Set the event and close what is to be closed with it."""
        super().set()
        with self._lock:
            closes, self._closes = self._closes, []
        for close in closes:
            close()

    @contextlib.contextmanager
    def closing(self, close: Callable[[], object]) -> Iterator[None]:
        """Call `close` once the event is set within the block, on the thread that sets it; at once if it is set."""
        with self._lock:
            self._closes.append(close)
        if self.is_set():
            self.set()
        try:
            yield
        finally:
            with self._lock, contextlib.suppress(ValueError):
                self._closes.remove(close)


@contextlib.contextmanager
def stopped_by_signals() -> Iterator[StopEvent]:
    """Yield an event that SIGINT, SIGTERM and SIGHUP set.

    An exception in the place of the event can be lost: NumPy replaces it by its own, and Python ignores it in callbacks
    such as those of the garbage collector. A thread sets the event, because a signal handler would wait for ever if it
    interrupts `Event.wait`, which holds the same lock.
    """
    stop = StopEvent()
    is_main = threading.current_thread() is threading.main_thread()  # only there Python allows handlers
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP) if is_main else ()
    heeded = [
        number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN
    ]  # not under nohup
    if not heeded:
        yield stop
        return
    with _woken_by_signals() as received:
        thread = threading.Thread(target=_set_on_signal, args=(received, heeded, stop), daemon=True)
        thread.start()
        before = {number: signal.signal(number, lambda number, frame: None) for number in heeded}
        try:
            yield stop
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


@contextlib.contextmanager
def _woken_by_signals() -> Iterator[int]:
    """The end of a pipe to read the numbers of signals from; its other end is closed with the block."""
    received, wakeup = os.pipe()
    os.set_blocking(wakeup, False)
    before = signal.set_wakeup_fd(wakeup, warn_on_full_buffer=False)
    try:
        yield received
    finally:
        signal.set_wakeup_fd(before)
        os.close(wakeup)


def _set_on_signal(received: int, numbers: Sequence[int], stop: threading.Event) -> None:
    """Set the event once one of the signals arrives; close `received` when no more can arrive."""
    with open(received, "rb", buffering=0) as pipe:
        while number := pipe.read(1):
            if number[0] in numbers:
                stop.set()
