# SPDX-License-Identifier: BSD-3-Clause
"""A program that sends mutated messages to all keys and queryables of a running arena.

It changes nothing that a valid message may change: valid messages concern only cameras and robots that do not exist,
and a camera of the rig (`FUZZED`) that has no node. Everything else is certainly invalid.
"""

import contextlib
import random
import threading
import time
from collections import Counter
from typing import Any

import msgspec
import tyro
import zenoh

from calib.rig.rig_messages import rig_history_key, rig_step_key
from camera_node.foundation.terminal import say
from camera_node.protocol.messages import Keys, Settings
from camera_node.protocol.registration import assigned_key, change_key, register_key, registered_key
from camera_node.protocol.session import open_client
from fusion.protocol.pose_messages import RobotsRequest
from tests.benchmarks.faults.mutation import certainly_invalid, clone, mutate, odd_text

FUZZED = "fuzzed"  # a camera of the rig whose detections are all mutated
GHOSTS = tuple(f"ghost{k}" for k in range(200))
OBSERVED_S = 2.0  # in which valid messages are collected
QUERY_S = 1.0  # timeout
PENDING = 50  # queries at a time
CLEAN_UP = 500  # requests for robots between two clean-ups
PARAMETERS = (
    "",
    "quality=0",
    "quality=99999999999",
    "quality=ü",
    "draw",
    "draw=1;quality=",
    ";;;",
    "=" * 5000,
    "_time=[..]",
)


class Fuzzer:
    """Sends faults to one arena over an open session.

    Attributes:
        counts: sent messages by target.
        replies: "answered" and "refused".
    """

    def __init__(self, session: zenoh.Session, arena: str, rng: random.Random) -> None:
        self.session, self.arena, self.rng = session, arena, rng
        self.keys = Keys(arena)
        self.counts: Counter[str] = Counter()
        self.replies: Counter[str] = Counter()
        self.samples = self._observe()
        self.robots = set(self.samples.get(f"{arena}/robots", {}).get("robots", {}))
        self._pending = threading.Semaphore(PENDING)
        self._targets: tuple[tuple[int, Any], ...] = (
            (25, self._send_fuzzed_detections),
            (10, self._send_ghost_detections),
            (10, self._send_broken),
            (15, self._send_ghost_output),
            (5, self._send_elsewhere),
            (10, self._query_robots),
            (10, self._query_rig),
            (10, self._query_node),
            (5, self._query_reader),
            (5, self._query_registry),
        )

    def send(self, only: str = "") -> None:
        """Send one fault; `only` restricts the targets to those with this in their names."""
        chosen = [(w, target) for w, target in self._targets if only in target.__name__]
        weights, targets = zip(*chosen, strict=True)
        self.rng.choices(targets, weights)[0]()

    def _observe(self) -> dict[str, Any]:
        """One valid message of each key, as a tree."""
        samples: dict[str, Any] = {}

        def take(sample: zenoh.Sample) -> None:
            with contextlib.suppress(msgspec.DecodeError):
                samples.setdefault(str(sample.key_expr), msgspec.msgpack.decode(sample.payload.to_bytes()))

        subscriber = self.session.declare_subscriber(f"{self.arena}/**", take)
        threading.Event().wait(OBSERVED_S)
        subscriber.undeclare()
        for key in (self.keys.rig, f"{self.arena}/robots", self.keys.clock):
            for reply in self.session.get(key, timeout=QUERY_S):
                if reply.ok is not None:
                    samples[key] = msgspec.msgpack.decode(reply.ok.payload.to_bytes())
        return samples

    def _sample(self, ending: str) -> Any:
        """A valid message of a kind, stamped now."""
        rows = [value for key, value in sorted(self.samples.items()) if key.endswith(ending)]
        message = clone(self.rng.choice(rows)) if rows else {"version": 1}
        now_ns = time.time_ns()
        return message | {name: now_ns for name in ("t_ns", "sent_ns") if name in message}

    def _put(self, key: str, data: bytes, target: str) -> None:
        self.counts[target] += 1
        try:
            self.session.put(key, data, congestion_control=zenoh.CongestionControl.BLOCK)
        except zenoh.ZError:
            self.counts["no key of Zenoh"] += 1

    def _get(self, key: str, data: bytes, target: str) -> None:
        """Query without waiting for the reply, as long as not too many replies are outstanding."""
        self.counts[target] += 1
        if not self._pending.acquire(timeout=2 * QUERY_S):
            raise TimeoutError(f"queries on {key} stay without an end")

        def take(reply: zenoh.Reply) -> None:
            self.replies["answered" if reply.ok is not None else "refused"] += 1

        selector = f"{key}?{self.rng.choice(PARAMETERS)}" if self.rng.random() < 0.3 else key
        handler = zenoh.handlers.Callback(take, self._pending.release)
        try:
            self.session.get(selector, handler, payload=data or None, timeout=QUERY_S)
        except zenoh.ZError:
            self._pending.release()

    # The targets.

    def _send_fuzzed_detections(self) -> None:
        """To the server's tracking: a camera of the rig."""
        message = self._sample("/detections") | {"camera": FUZZED, "seq": self.rng.randrange(10**6)}
        self._put(
            self.keys.detections(FUZZED), mutate(message, self.rng), "detections of a camera of the rig"
        )

    def _send_ghost_detections(self) -> None:
        name = self.rng.choice(GHOSTS)
        kind = self.rng.choice(("detections", "status"))
        message = self._sample(f"/{kind}") | {"camera": name}
        self._put(
            f"{self.arena}/camera/{name}/{kind}", mutate(message, self.rng), f"{kind} of unknown cameras"
        )

    def _send_broken(self) -> None:
        """To every key on which somebody publishes."""
        key = self.rng.choice(sorted(self.samples))
        self._put(key, certainly_invalid(self.samples[key], self.rng), "invalid messages on all keys")

    def _send_ghost_output(self) -> None:
        """To viewer, client and recorder: results of a server."""
        name = self.rng.choice(GHOSTS)
        pose = self._sample("/pose") | {"robot": name}
        key, message = self.rng.choice(
            (
                (self.keys.robot_pose(name), pose),
                (self.keys.poses, {"version": 1, "poses": [mutate(pose, self.rng)]}),
                (assigned_key(self.arena, name), {"version": 1, "id": name, "name": name, "settings": {}}),
                (self.keys.markers, self._sample("/markers")),
                (self.keys.fusion_status, self._sample("/fusion/status")),
                (f"{self.arena}/fusion/zone/b/report", self._sample("/pose")),
                (
                    f"{self.arena}/demo/progress",
                    {"version": 1, "t_ns": 0, "text": "x", "share": 0.5, "true_points": {}},
                ),
            )
        )
        self._put(key, mutate(message, self.rng), "results of a server")

    def _send_elsewhere(self) -> None:
        """To keys that no program declares."""
        middle = self.rng.choice(("camera", "robot", "fusion", "rig", "robots", "x"))
        key = f"{self.arena}/{middle}/{odd_text(self.rng)[:200]}/{self.rng.choice(('pose', 'detections', 'status'))}"
        self._put(key, mutate(self._sample("/detections"), self.rng), "undefined keys")

    def _query_robots(self) -> None:
        body = {"diameter_m": 0.1, "markers": [[0.2, 0.0, 0.0], [-0.23, 0.2, 0.0], [0.0, -0.27, 0.0]]}
        request = {"version": 1, "rename": {}, "remove": [], "define": {"guest": body}}
        data = mutate(request, self.rng)
        key = f"{self.arena}/robots/set" if self.rng.random() < 0.8 else f"{self.arena}/robots"
        self._get(key, data, "changes of robots")
        if self.counts["changes of robots"] % CLEAN_UP == 0:
            self.clean_up()

    def _query_rig(self) -> None:
        """Only the entry of a camera that does not exist is mutated: an accepted rig changes no pose."""
        message = self._sample("/rig")
        rig = message.get("rig", {})
        if "cameras" in rig and self.rng.random() < 0.8:
            phantom = clone(next(iter(rig["cameras"].values())))
            phantom.pop("T_world_cam", None)
            entry = self._mutated_tree(phantom)
            rig["cameras"][odd_text(self.rng) if self.rng.random() < 0.2 else "phantom"] = entry
            data = msgspec.msgpack.encode(message)
        else:
            data = certainly_invalid(message, self.rng)
        ending = self.rng.choice(("rig/set", "rig/set", "rig/set", "rig"))
        self._get(f"{self.arena}/{ending}", data, "changes of the rig")

    def _mutated_tree(self, tree: Any) -> Any:
        try:
            return msgspec.msgpack.decode(mutate(tree, self.rng))
        except (msgspec.DecodeError, RecursionError, ValueError):
            return None

    def _query_node(self) -> None:
        camera = self.rng.choice([k.split("/")[2] for k in self.samples if k.endswith("/detections")])
        if self.rng.random() < 0.3:
            self._get(self.keys.snapshot(camera), self.rng.randbytes(10), "snapshots")
            return
        settings = msgspec.to_builtins(Settings(exposure_us=100.0, mask=(((0, 0), (1, 0), (0, 1)),)))
        data = mutate(settings, self.rng)
        if self.rng.random() < 0.2:
            data = b"{" + data
        self._get(self.keys.settings(camera), data, "settings")

    def _query_reader(self) -> None:
        answering = (self.keys.clock, self.keys.rig, f"{self.arena}/robots")
        key = self.rng.choice((*answering, rig_history_key(self.arena), registered_key(self.arena)))
        self._get(key, mutate({"version": 1}, self.rng), "questions")

    def _query_registry(self) -> None:
        """Cameras and the history of the rig: every valid request would change what the others rely on."""
        requests = {
            register_key(self.arena): {
                "version": 1,
                "id": "ghost",
                "driver": "sim",
                "width": 640,
                "height": 480,
            },
            change_key(self.arena): {"version": 1, "camera": "ghost0", "name": "ghost1", "forget": True},
            rig_step_key(self.arena, "undo"): {"version": 1, "source": {"program": "fuzzer"}},
            rig_step_key(self.arena, "redo"): {"version": 1, "source": {"program": "fuzzer"}},
        }
        key = self.rng.choice(sorted(requests))
        self._get(key, certainly_invalid(requests[key], self.rng) or b"\xc1", "registry and history")

    def clean_up(self) -> None:
        """Remove the robots that were defined."""
        for reply in self.session.get(f"{self.arena}/robots", timeout=QUERY_S):
            if reply.ok is None:
                continue
            names = set(msgspec.msgpack.decode(reply.ok.payload.to_bytes())["robots"]) - self.robots
            request = RobotsRequest(remove=tuple(names))
            data = msgspec.msgpack.encode(request)
            list(self.session.get(f"{self.arena}/robots/set", payload=data, timeout=QUERY_S))


def main(
    connect: str, arena: str, messages: int = 1000, rate: float = 2000.0, seed: int = 1, only: str = ""
) -> None:
    """Send faults; print how many were sent once a second, and at the end how many to which target.

    Args:
        connect: Zenoh endpoint of the server.
        arena: its name.
        messages: how many.
        rate: a second.
        seed: of the choices.
        only: part of the name of a target, such as robots; all unless given.
    """
    with open_client([connect]) as session:
        fuzzer, pause = Fuzzer(session, arena, random.Random(seed)), threading.Event()
        begun_s, said_s = time.monotonic(), 0.0
        for k in range(messages):
            fuzzer.send(only)
            pause.wait(max(0.0, begun_s + k / rate - time.monotonic()))
            if time.monotonic() - said_s > 1.0:
                said_s = time.monotonic()
                say(f"sent {k}")
        pause.wait(2 * QUERY_S)
        fuzzer.clean_up()
    for target, count in (*fuzzer.counts.items(), *fuzzer.replies.items()):
        say(f"{target}: {count}")
    say(f"sent {messages}")


if __name__ == "__main__":
    tyro.cli(main)
