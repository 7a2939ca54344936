"""What a plant asks of its loop: modes, set points, types of values, and who has it."""

from __future__ import annotations

from pathlib import Path

from asyncua import ua
from plant_servers import SPACE, UNKNOWN, Plant, RunningLoop, Wire
from processes import within
from served_plant import MODE, RECOVER, begun, read, served, wired, write  # noqa: F401

from loopwright.serving import Mode
from loopwright.serving.opcua.settings import HandBack
from loopwright.serving.station.settings import Hold


def test_an_mv_node_of_another_type_is_not_written_while_it_is(plant: Plant, wire: Wire, tmp_path: Path) -> None:
    """The loop holds and says so, and goes on by itself once the type is the old one."""
    running = begun(tmp_path, wire.port)
    running.becomes(Mode.AUTO, scans=8)
    try:
        write(plant, "Faults.MV.T_j", "int")
        changed = "MV T_j, written: its type is Int32 now and was Double"
        assert within(30, lambda: changed in running.commands[-1].fault), running.told
        running.becomes(Mode.HOLD, scans=8)
        asked = {row["asked"][0] for row in plant.actuator()[-6:]}
        assert len(asked) == 1
    finally:
        write(plant, "Faults.MV.T_j", "")
    running.becomes(Mode.AUTO, 60, scans=8)
    running.end()


def wished(running: RunningLoop, plant: Plant, mode: Mode) -> None:
    """The plant's operator takes a loop out of the shadow: once more where it had just lost its plant and refused."""
    for _ in range(5):
        before = len(running.told)
        write(plant, "Control.Mode", int(MODE.values["SHADOW"]), ua.VariantType.Int32)
        assert within(20, lambda: "plant: mode SHADOW" in running.told[before:])  # noqa: B023
        write(plant, "Control.Mode", int(MODE.values[mode]), ua.VariantType.Int32)

        def refused() -> bool:
            return any(UNKNOWN in line for line in running.told[before:])  # noqa: B023

        assert within(20, lambda: running.commands[-1].mode is mode or refused()), running.told
        if running.commands[-1].mode is mode:
            return
    raise AssertionError(running.told)


def test_the_plants_own_operator_sets_mode_and_set_point(plant: Plant, wire: Wire, tmp_path: Path) -> None:
    write(plant, "Control.Mode", 1, ua.VariantType.Int32)  # from before; no wish of now
    running = begun(tmp_path, wire.port, start="SHADOW", nodes={"mode": MODE, "sp": {"C_A": f"{SPACE}SP.C_A"}})
    running.becomes(Mode.SHADOW, scans=6)
    wished(running, plant, Mode.MANUAL)
    write(plant, "Control.Mode", 1, ua.VariantType.Int32)
    running.becomes(Mode.AUTO)
    write(plant, "SP.C_A", 0.9)
    assert within(20, lambda: running.commands[-1].sp.tolist() == [0.9])
    write(plant, "SP.C_A", 1.7)
    assert within(20, lambda: any("refused: set point C_A 1.7" in line for line in running.told))
    assert running.commands[-1].sp.tolist() == [0.9]
    running.end()


def test_a_plant_is_handed_back_and_asked_for_again(plant: Plant, wire: Wire, tmp_path: Path) -> None:
    running = begun(
        tmp_path,
        wire.port,
        nodes={"hand_back": HandBack(f"{SPACE}Control.Owner", 0)},
        hold=Hold(recover_after=RECOVER, max_s=10.0, then="hand back"),
    )
    running.becomes(Mode.AUTO, scans=5)
    write(plant, "Faults.PV.T", "bad")
    running.becomes(Mode.SHADOW)
    assert read(plant, "Control.Owner") == 0
    write(plant, "Faults.PV.T", "")
    running.becomes(Mode.SHADOW, scans=10)  # who has the plant now decides
    write(plant, "Control.Owner", 1, ua.VariantType.Int32)
    assert within(20, lambda: running.ask(lambda loop: loop.set_mode(Mode.AUTO), "mode AUTO") == "")
    running.becomes(Mode.AUTO, scans=5)
    running.end()
