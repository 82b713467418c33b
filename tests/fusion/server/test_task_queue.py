# SPDX-License-Identifier: BSD-3-Clause
"""The server's queue: each sender has its own limit, and requests take a bounded share of the time."""

from fusion.server.fair_use import Task, TaskQueue
from tests.waiting import poll


def task(sender: str, received_ns: int, is_request: bool = False) -> Task:
    return Task(sender, received_ns, lambda: None, lambda: None, is_request)


def drain(tasks: TaskQueue) -> list[tuple[str, int]]:
    """The tasks that may be executed now."""
    taken = []
    while (t := tasks.take(0.0)) is not None:
        taken.append((t.sender, t.received_ns))
    return taken


def test_a_flood_displaces_only_its_own_tasks_and_keeps_the_newest():
    tasks = TaskQueue()
    tasks.put(task("slow", 0), 4)
    dropped = [tasks.put(task("fast", k), 4) for k in range(1, 101)]
    tasks.put(task("slow", 101), 4)
    assert [t.received_ns for t in dropped if t] == list(range(1, 97))
    assert drain(tasks) == [("slow", 0), *(("fast", k) for k in range(97, 101)), ("slow", 101)]


def test_a_request_beyond_the_limit_is_refused_and_earlier_ones_stay():
    tasks = TaskQueue()
    newest = [tasks.put(task("key", k, is_request=True), 2) for k in range(3)][-1]
    assert newest is not None
    assert newest.received_ns == 2
    assert drain(tasks) == [("key", 0), ("key", 1)]


def test_requests_wait_after_a_long_one_and_messages_do_not():
    tasks = TaskQueue()
    tasks.charge_request(0.02)
    tasks.put(task("request", 0, is_request=True), 4)
    tasks.put(task("message", 1), 4)
    assert drain(tasks) == [("message", 1)]
    assert not tasks.has_messages()
    assert poll(lambda: drain(tasks)) == [("request", 0)]
