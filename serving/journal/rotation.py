"""Entries that leave a journal that would grow too large: the oldest scans, events and runs."""

from __future__ import annotations

import sqlite3

EVENT_SHARE, EVENT_BYTES = 0.05, 400  # of the size for scans; of an event with its indexes
LEAST_EVENTS = 1_000
SLACK = 0.1  # of the events, by which there may be more until some go

# Of each alarm its newest event, which says whether it is active; and the newest alarms that nobody has acknowledged.
# With them their ends and acknowledgments.
KEPT = (
    "create temp table if not exists kept (id integer primary key)",
    "delete from kept",
    "insert into kept select max(id) from event where alarm != '' group by alarm",
    """insert or ignore into kept select e.id from event e where e.raised
        and not exists (select 1 from event a where a.about = e.id) order by e.id desc limit :unseen""",
    """insert or ignore into kept select n.id from (
        select (select min(n.id) from event n where n.alarm = e.alarm and n.id > e.id) as id
        from event e join kept k on k.id = e.id) n where n.id is not null""",
    "insert or ignore into kept select a.id from event a join kept k on a.about = k.id",
)


def most_events(max_bytes: float) -> int:
    """How many events a journal keeps beside ``max_bytes`` of scans."""
    return max(LEAST_EVENTS, int(EVENT_SHARE * max_bytes / EVENT_BYTES))


def shorten_scans(base: sqlite3.Connection, max_bytes: float) -> None:
    """Drop the oldest blocks of scans, and the runs that have none any more."""
    (size,) = base.execute("select coalesce(sum(length(data)), 0) from block").fetchone()
    if size <= max_bytes:
        return
    for first, length in base.execute("select first, length(data) from block order by first").fetchall():
        base.execute("delete from block where first = ?", (first,))
        size -= length
        if size <= max_bytes:
            break
    base.execute("delete from run where id < (select min(run) from (select run from block union select run from scan))")


def shorten_events(base: sqlite3.Connection, most: int) -> None:
    """Drop the oldest events beyond ``most``.

    The state of active alarms stays; of those that are over and not acknowledged, as many as are half of ``most``.
    """
    (count,) = base.execute("select count(*) from event").fetchone()
    if count <= most * (1 + SLACK):
        return
    for statement in KEPT:
        base.execute(statement, {"unseen": most // 2} if ":unseen" in statement else {})
    old = "select id from event where id not in (select id from kept) order by id limit ?"
    base.execute(f"delete from event where id in ({old})", (count - most,))
