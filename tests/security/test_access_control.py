# SPDX-License-Identifier: BSD-3-Clause
"""Every rule of configs/zenoh/server.json5, with real clients of each role.

A server's session, which has all rights, observes which messages of a client the server lets through. Denied messages
precede an allowed one on the same link, so they would arrive before it.
"""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field

import pytest
import zenoh

from tests.security.lab import ARENA, KEYS, Lab, certificates
from tests.waiting import Inbox, wait_for

CAMERAS = ("north", "south")
SERVER_READS = ("clock", "rig", "rig/history", "robots")
SERVER_CHANGES = ("rig/set", "rig/undo", "rig/redo", "robots/set")
CAMERA_KEYS = ("detections", "relative", "status", "alive", "snapshot", "settings", "@preview")
PUBLISHED = (
    "markers",
    "robot/a/pose",
    "@poses",
    "fusion/status",
    "fusion/zone/b/report",
    "fusion/zone/b/states/a",
    "fusion/alive",
    "rig",
)
ALL = frozenset(
    {f"camera/{camera}/{key}" for camera in CAMERAS for key in CAMERA_KEYS}
    | {*SERVER_READS, *SERVER_CHANGES, *PUBLISHED, "calib/wand", "demo/progress", "other"}
)
SNAPSHOTS = {f"camera/{camera}/snapshot" for camera in CAMERAS}
SETTINGS = {f"camera/{camera}/settings" for camera in CAMERAS}
ANSWER_S = 2.0
IN_NO_WILDCARD = (KEYS.preview(), KEYS.poses)  # keys with an @
EMPTY_ARENA = "empty"  # whose tokens are not the server's; the rules are for all arenas


@dataclass(frozen=True)
class Rights:
    """The keys that a role may use, without the arena's name."""

    put: set[str] = field(default_factory=set)
    delete: set[str] = field(default_factory=set)
    token: set[str] = field(default_factory=set)
    query: set[str] = field(default_factory=set)
    answer: set[str] = field(default_factory=set)
    receive: set[str] = field(default_factory=set)


VIEWER = Rights(query={*SERVER_READS, *SNAPSHOTS}, receive={*ALL})
OPERATOR = Rights(token={"calib/wand"}, query={*VIEWER.query, *SERVER_CHANGES, *SETTINGS}, receive={*ALL})
RIGHTS = {
    "camera.north": Rights(
        put={f"camera/north/{key}" for key in ("detections", "relative", "status", "@preview")},
        token={"camera/north/alive"},
        query={"clock", "rig"},
        answer={"camera/north/snapshot", "camera/north/settings"},
        receive={"rig"},
    ),
    "viewer": VIEWER,
    "viewer.logger": VIEWER,
    "operator": OPERATOR,
    "operator.bob": OPERATOR,
}


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    folder = tmp_path_factory.mktemp("lab")
    certificates(folder, "localhost", "camera.south", *RIGHTS).check_returncode()
    with contextlib.ExitStack() as closing:
        yield Lab(folder, closing)


class Observer:
    """A session with all rights that records what arrives: (kind, key, sender) for each message."""

    def __init__(self, session: zenoh.Session) -> None:
        self.session, self.inbox = session, Inbox()
        everything = f"{ARENA}/**"
        self._entities = (
            session.declare_subscriber(everything, self._receive),
            *(session.declare_subscriber(key, self._receive) for key in IN_NO_WILDCARD),
            session.declare_queryable(everything, self._answer),
            session.declare_queryable(KEYS.preview(), self._answer),
            session.liveliness().declare_subscriber(f"{EMPTY_ARENA}/**", self._note_token),
        )

    def _receive(self, sample: zenoh.Sample) -> None:
        kind = "put" if sample.kind == zenoh.SampleKind.PUT else "delete"
        sender = sample.attachment.to_string() if sample.attachment else "server"
        self.inbox.put((kind, str(sample.key_expr), sender))

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            sender = query.attachment.to_string() if query.attachment else "server"
            self.inbox.put(("query", str(query.key_expr), sender))
            query.reply(query.key_expr, b"observer")

    def _note_token(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            self.inbox.put(("token", str(sample.key_expr).removeprefix(EMPTY_ARENA).lstrip("/"), "anybody"))

    def keys(self, kind: str, sender: str) -> set[str]:
        """The keys of the messages of a kind and a sender, without the arena's name."""
        return {
            key.removeprefix(f"{ARENA}/") for k, key, s in list(self.inbox.items) if (k, s) == (kind, sender)
        }

    def close(self) -> None:
        for entity in self._entities:
            entity.undeclare()


@pytest.fixture
def observer(lab: Lab) -> Iterator[Observer]:
    observer = Observer(lab.session("server"))
    yield observer
    observer.close()


# Zenoh's mode of the client: Roundel's programs are routers without listeners. Such a router does not send publications
# without a known subscriber; the other modes do.
CLIENTS = [
    (name, mode) for name in ("camera.north", "viewer", "operator") for mode in ("router", "client", "peer")
]
each_client = pytest.mark.parametrize(
    ("name", "mode"), [*CLIENTS, ("viewer.logger", "router"), ("operator.bob", "router")]
)


def open_session(lab: Lab, name: str, mode: str) -> zenoh.Session:
    return lab.session(name) if mode == "router" else lab.bare_session(name, mode)


def ask(session: zenoh.Session, key: str, sender: str = "") -> list[bytes]:
    """All replies to a query, of all queryables."""
    target, consolidation = zenoh.QueryTarget.ALL, zenoh.ConsolidationMode.NONE
    replies = session.get(
        f"{ARENA}/{key}", target=target, consolidation=consolidation, attachment=sender, timeout=ANSWER_S
    )
    return [reply.ok.payload.to_bytes() for reply in replies if reply.ok]


def pass_through(observer: Observer, session: zenoh.Session, sender: str) -> None:
    """Wait until all that `session` sent before has reached the observer, if the server let it through."""
    wait_for(lambda: b"observer" in ask(session, "clock", sender))


@each_client
def test_a_client_sends_what_its_role_may_send(lab: Lab, observer: Observer, name: str, mode: str):
    """It puts, deletes, queries and declares a token on every key."""
    session, rights = open_session(lab, name, mode), RIGHTS[name]
    pass_through(observer, session, "beforehand")
    with contextlib.ExitStack() as stack:
        for key in sorted(ALL):
            session.put(f"{ARENA}/{key}", b"\xc1", attachment=name)
            session.delete(f"{ARENA}/{key}", attachment=name)
            session.get(
                f"{ARENA}/{key}",
                lambda _: None,
                target=zenoh.QueryTarget.ALL,
                attachment=name,
                timeout=ANSWER_S,
            )
            stack.callback(session.liveliness().declare_token(f"{EMPTY_ARENA}/{key}").undeclare)
        pass_through(observer, session, "afterwards")
        assert observer.keys("put", name) == rights.put
        assert observer.keys("delete", name) == rights.delete
        assert observer.keys("query", name) == rights.query
        assert observer.keys("token", "anybody") == rights.token


@each_client
def test_a_client_answers_its_own_requests_only(lab: Lab, observer: Observer, name: str, mode: str):
    """It declares a queryable on every key, and one on all keys; a server asks all queryables."""
    session = open_session(lab, name, mode)

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, name.encode())

    with contextlib.ExitStack() as stack:
        for key in (*sorted(ALL), "**"):
            stack.callback(session.declare_queryable(f"{ARENA}/{key}", answer).undeclare)
        pass_through(observer, session, "afterwards")
        answered = {key for key in ALL if name.encode() in ask(observer.session, key)}
    assert answered == RIGHTS[name].answer


@each_client
def test_a_client_receives_what_its_role_may_receive(lab: Lab, observer: Observer, name: str, mode: str):
    """A server publishes on every key; the client subscribes to each, and to all. A query to the client follows."""
    session, received = open_session(lab, name, mode), Inbox()
    subscribers = [
        session.declare_subscriber(
            key, lambda sample: received.put(str(sample.key_expr).removeprefix(f"{ARENA}/"))
        )
        for key in (f"{ARENA}/**", *IN_NO_WILDCARD, *(f"{ARENA}/{key}" for key in sorted(ALL)))
    ]
    queryable = session.declare_queryable(
        KEYS.settings("north"), lambda query: received.put("end") or query.drop()
    )
    pass_through(observer, session, "afterwards")

    def publish() -> None:
        for key in (*sorted(ALL), "end"):
            observer.session.put(f"{ARENA}/{key}", b"\xc1")

    publish()
    wait_for(lambda: RIGHTS[name].receive <= set(received.items), publish)  # routes may take a moment
    observer.session.get(
        KEYS.settings("north"), lambda _: None, target=zenoh.QueryTarget.ALL, timeout=ANSWER_S
    )
    assert received.until(lambda items: "end" in items)
    assert set(received.items) & ALL == RIGHTS[name].receive
    for entity in (*subscribers, queryable):
        entity.undeclare()


@each_client
def test_a_client_sees_who_is_there(lab: Lab, observer: Observer, name: str, mode: str):
    """All see the server's token, which shows a camera that the server is away; a camera sees no other tokens."""
    session, key = open_session(lab, name, mode), "camera/south/alive"
    token = observer.session.liveliness().declare_token(f"{ARENA}/{key}")

    def present() -> set[str]:
        replies = session.liveliness().get(f"{ARENA}/**", timeout=ANSWER_S)
        return {str(reply.ok.key_expr).removeprefix(f"{ARENA}/") for reply in replies if reply.ok}

    if RIGHTS[name].receive == ALL:
        wait_for(lambda: {"fusion/alive", key} <= present())
    else:
        changes = Inbox()
        watch = session.liveliness().declare_subscriber(
            KEYS.fusion_alive, lambda sample: changes.put(str(sample.key_expr)), history=True
        )
        assert changes.until(lambda items: KEYS.fusion_alive in items)
        assert key not in present()
        watch.undeclare()
    token.undeclare()


def test_a_certificate_without_a_rule_gives_no_rights(lab: Lab):
    """It was created after the server started. During that time a viewer's queries are answered."""
    certificates(lab.folder, "localhost", "viewer.late").check_returncode()
    late, viewer = lab.bare_session("viewer.late", "client"), lab.session("viewer")
    assert late.info.routers_zid() == viewer.info.routers_zid(), "both are connected"
    wait_for(lambda: ask(viewer, "clock"))
    assert not any(ask(late, key) for key in SERVER_READS)
