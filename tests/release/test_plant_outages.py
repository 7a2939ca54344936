"""What a loop and its plant do when one of them is gone for a while, or starts anew."""

from __future__ import annotations

import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest
from asyncua import ua
from plant_servers import CASE, PID, ROOT, SPACE, Plant, Wire, loop_toml
from processes import within
from served_plant import MODE, PERIOD_S, SPEED, begun, cut, mend, read, served, told, wired, write  # noqa: F401

from loopwright.serving import Controller, Mode
from loopwright.serving.station.settings import Hold

START = 250.0  # the MV of the plant's start
LEARNT_WITHIN = 3  # of the loop's own periods: so soon a plant knows that its loop is gone


def test_a_plant_learns_within_three_periods_that_its_loop_was_killed(plant: Plant, tmp_path: Path) -> None:
    """By the server's own count of periods: a busy machine changes nothing about that."""
    served_period_s = PERIOD_S * SPEED  # of the plant's own time
    beats_at = f'heartbeat = "{SPACE}Control.Heartbeat"'
    path = loop_toml(tmp_path, plant.endpoint, speed=SPEED, nodes=beats_at)
    since = len(plant.actuator())
    command = [sys.executable, "-m", "loopwright.pipeline", "loop", "run", str(path)]
    with (tmp_path / "said").open("w") as said:
        loop = subprocess.Popen(command, cwd=ROOT, stdout=said, stderr=said)
    try:

        def beats() -> int:
            rows = plant.actuator()[since:]
            return sum(a["beat"] != b["beat"] and b["alive"] for a, b in pairwise(rows))

        assert within(120, lambda: beats() > 10), (tmp_path / "said").read_text()
    finally:
        loop.kill()
        loop.wait()
    killed = len(plant.actuator())
    assert within(60, lambda: len(plant.actuator()) > killed + 10)
    rows = plant.actuator()
    last = max(i for i in range(since + 1, len(rows)) if rows[i]["beat"] != rows[i - 1]["beat"])
    assert last <= killed + 1
    learnt = next(i for i in range(last, len(rows)) if not rows[i]["alive"])
    silent_s = (rows[learnt]["k"] - rows[last]["k"]) * served_period_s
    assert 0 < silent_s <= LEARNT_WITHIN * Controller(PID).manifest.period_s
    assert not any(row["alive"] for row in rows[learnt:])
    assert read(plant, "Control.LoopAlive") is False
    assert len({row["asked"][0] for row in rows[learnt:]}) == 1  # the actuator keeps what it has


def test_what_a_plant_shows_that_started_anew_is_no_wish_until_it_changes(tmp_path: Path) -> None:
    """Its set point and its mode are defaults then; after a mere outage of the network a new value is a wish."""
    plant = Plant(tmp_path, CASE, SPEED)
    plant.start()
    wire = Wire(plant.port)
    try:
        write(plant, "Control.Mode", 1, ua.VariantType.Int32)
        write(plant, "SP.C_A", 0.9)
        running = begun(tmp_path, wire.port, nodes={"mode": MODE, "sp": {"C_A": f"{SPACE}SP.C_A"}})
        running.becomes(Mode.AUTO, scans=8)
        assert running.commands[-1].sp.tolist() == [0.9]

        cut(plant, wire)  # the network alone
        running.becomes(Mode.HOLD, scans=6)
        write(plant, "SP.C_A", 0.85)
        wire.cut = False
        running.becomes(Mode.AUTO, scans=5)
        assert within(20, lambda: running.commands[-1].sp.tolist() == [0.85])
        assert told(running, "started anew") == []

        plant.end()
        running.becomes(Mode.HOLD, scans=6)
        plant.start()
        assert read(plant, "Control.Mode") == 2  # SHADOW, and a set point that nobody asked for
        assert read(plant, "SP.C_A") != 0.85
        running.becomes(Mode.AUTO, scans=8)
        assert running.commands[-1].sp.tolist() == [0.85]
        assert len(told(running, "no wish of its operator until they change")) == 1
        assert len(told(running, ": it has started anew")) == 1

        write(plant, "SP.C_A", 0.8)
        assert within(20, lambda: running.commands[-1].sp.tolist() == [0.8])
        write(plant, "Control.Mode", 0, ua.VariantType.Int32)
        running.becomes(Mode.MANUAL)
        running.end()
    finally:
        wire.close()
        plant.end()


@pytest.mark.parametrize("spoilt", ["", "bad"])
def test_what_the_plants_operator_set_during_an_outage_is_not_written_over(
    spoilt: str, plant: Plant, wire: Wire, tmp_path: Path
) -> None:
    """HOLD goes on from where the MV stands, also while a PV is bad; MANUAL too."""
    running = begun(tmp_path, wire.port, hold=Hold(recover_after=0))  # it holds for all that is looked at below

    def in_auto() -> bool:
        """For some scans; its operator has it go on where a busy machine had it hold."""
        if running.commands[-1].mode is not Mode.AUTO:
            running.ask(lambda loop: loop.set_mode(Mode.AUTO), "mode AUTO")
        return len(running.since(0, Mode.AUTO)) >= 8 and running.commands[-1].mode is Mode.AUTO

    try:
        assert within(120, in_auto)
        for begin in (Mode.HOLD, Mode.MANUAL):
            if begin is Mode.MANUAL:
                assert running.ask(lambda loop: loop.set_mode(Mode.MANUAL), "mode MANUAL") == ""
                running.becomes(Mode.MANUAL, scans=3)
            cut(plant, wire)
            assert within(20, lambda: "does not answer" in running.commands[-1].fault)
            running.becomes(begin, scans=6)
            assert running.station.loop is not None
            (left,) = running.station.loop.mv.tolist()
            moved = round(left) + (61.0 if left < START else -61.0)  # more than an actuator may differ from its command
            write(plant, "MV.T_j", moved)
            write(plant, "Faults.PV.T", spoilt)
            n = len(running.commands)
            since = len(plant.actuator())
            mend(plant, wire)
            assert within(30, lambda: running.commands[-1].mv.tolist() == [moved]), (moved, running.told)  # noqa: B023
            assert within(20, lambda: len(running.commands) > n + 20)  # noqa: B023
            write(plant, "Faults.PV.T", "")
            running.becomes(begin, scans=5)
            assert within(20, lambda: len(plant.actuator()) > since + 12)  # noqa: B023
            rows = plant.actuator()[since + 1 :]
            assert {row["asked"][0] for row in rows} == {moved}
            assert told(running, f"the MV stands at T_j {moved:g} K, not at T_j ")
    finally:
        write(plant, "Faults.PV.T", "")
    running.end()


def test_a_node_that_is_gone_while_the_connection_is_made_anew_is_found_again(
    plant: Plant, wire: Wire, tmp_path: Path
) -> None:
    """The server then tells no type of it; the loop asks again until there is one."""
    running = begun(tmp_path, wire.port)
    try:
        running.becomes(Mode.AUTO, 120, scans=5)
        write(plant, "Faults.MV.T_j", "deleted")
        running.becomes(Mode.HOLD)
        cut(plant, wire)
        assert within(20, lambda: "does not answer" in running.commands[-1].fault)
        mend(plant, wire)
        assert within(30, lambda: "so its type is not known" in running.commands[-1].fault)
        write(plant, "Faults.MV.T_j", "")
        running.becomes(Mode.AUTO, 60, scans=5)
    finally:
        write(plant, "Faults.MV.T_j", "")
        running.end()
