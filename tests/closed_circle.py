"""The closed circle: a sluggish PI on a served plant, its journal as data, a controller of these data in its place.

``python tests/closed_circle.py record FOLDER [CASE]`` runs a loop and exports its journal; then `loopwright new` and
`loopwright run` make a controller of it; ``python tests/closed_circle.py swap FOLDER CONTROLLER [CASE]`` swaps it in.
CASE is a key of CIRCLES, by default the first.
"""

from __future__ import annotations

import random
import sys
from dataclasses import dataclass
from pathlib import Path

from plant_servers import Plant, RunningLoop
from processes import within

from loopwright.pipeline.__main__ import main
from loopwright.pipeline.cases import PLANTS
from loopwright.pipeline.export.gate import export
from loopwright.pipeline.laws.pid.pid import PID
from loopwright.serving.station.control import ask


@dataclass(frozen=True)
class Circle:
    """A plant and its operation: set points of ``span``, each for ``hold`` scans; after the swap a move between two."""

    case: str
    sp: str
    kc: float  # [mv/pv] of the PI before: a third of a good one, so that chance does not decide whether the new one is
    ti_s: float  # better than it
    speed: float
    max_age_s: tuple[float, float]  # as written, as a plant that runs so fast needs it
    rows: int
    span: tuple[float, float]
    hold: tuple[int, int]
    move: tuple[float, float]
    near: float


CIRCLES = {
    # A period of 60 s in 50 ms.
    "ph_neutralization": Circle(
        "ph_neutralization", "pH", 14.0, 180.0, 1200.0, (90, 1200), 1_500, (6.6, 8.8), (5, 40), (7.2, 7.6), 0.15
    ),
    # A second PV is measured, and is in the journal. A period of 2 s in 67 ms.
    "reversible_cstr": Circle(
        "reversible_cstr", "C_B", -1.0, 12.0, 30.0, (3, 60), 3_000, (0.35, 0.54), (15, 120), (0.40, 0.48), 0.01
    ),
}


def pi_of(circle: Circle) -> PID:
    """The PI that ran the plant before."""
    simulated = PLANTS[circle.case]()
    return PID.design(PID.Params(tuning="manual", kc=circle.kc, ti_s=circle.ti_s), {}, simulated.signals, simulated)


def begun(folder: Path, circle: Circle, file: Path, *, unproven: bool = False) -> tuple[Plant, RunningLoop]:
    """The plant and its loop of a file, in AUTO."""
    folder = folder.absolute()  # the plant's process has a folder of its own
    folder.mkdir(parents=True, exist_ok=True)
    plant = Plant(folder, circle.case, circle.speed, "--noise")
    plant.start()
    path = folder / "loop.toml"
    path.unlink(missing_ok=True)
    assert main(["loop", "init", str(file), "--endpoint", plant.endpoint, "--out", str(path)]) == 0
    settings = f"speed = {circle.speed}\naccept_unproven = {str(unproven).lower()}"
    text = path.read_text().replace('page = "127.0.0.1:8080"', settings).replace("SHADOW", "AUTO", 1)
    written, patient = (f"max_age_s = {age:g}" for age in circle.max_age_s)
    assert written in text
    path.write_text(text.replace(written, patient))
    return plant, RunningLoop(path)


def record(folder: Path, circle: Circle) -> None:
    """Set points that move now and then, and the journal as an export."""
    folder.mkdir(parents=True, exist_ok=True)
    export(pi_of(circle), folder / "pi.onnx", case=circle.case, provenance={})
    plant, loop = begun(folder, circle, folder / "pi.onnx", unproven=True)  # no closed loop proved it
    rng, journal = random.Random(0), loop.settings.journal.file
    try:
        while loop.station.scans < circle.rows:
            ask(journal, {"do": "sp", "value": {circle.sp: rng.uniform(*circle.span)}, "who": "engineer"})
            until = loop.station.scans + rng.randint(*circle.hold)
            assert within(60, lambda: loop.station.scans >= until)  # noqa: B023
    finally:
        loop.end()
        plant.end()
    assert main(["loop", "export", str(journal), "--out", str(folder / "loop.csv")]) == 0


def swap(folder: Path, controller: Path, circle: Circle) -> None:
    """The new controller takes over from the case's own, which asks for a proven one, and holds a set point."""
    plant, loop = begun(folder / "swap", circle, Path("artifacts", circle.case, "pid.onnx"))
    journal = loop.settings.journal.file
    try:
        ask(journal, {"do": "sp", "value": {circle.sp: circle.move[0]}, "who": "engineer"})
        ask(journal, {"do": "swap", "value": {"file": str(controller.absolute()), "trial": 40}, "who": "engineer"})
        assert within(60, lambda: loop.station.loop is not None and loop.station.loop.replaced is not None)
        ask(journal, {"do": "sp", "value": {circle.sp: circle.move[1]}, "who": "engineer"})

        def held() -> bool:
            now = ask(journal, {"do": "state"})
            near = now["pv"] is not None and abs(now["pv"][0] - circle.move[1]) < circle.near
            return near and now["mode"] == "AUTO"

        assert within(60, held), ask(journal, {"do": "state"})
    finally:
        loop.end()
        plant.end()
    print(f"closed circle: {controller} has the plant, and holds its set point")


if __name__ == "__main__":
    doing, folder, *rest = sys.argv[1:]
    if doing == "record":
        record(Path(folder), CIRCLES[(*rest, *CIRCLES)[0]])
    else:
        swap(Path(folder), Path(rest[0]), CIRCLES[(*rest[1:], *CIRCLES)[0]])
