"""The closed circle: a loop on a served plant, its journal as data, a controller of these data in that loop.

``python tests/closed_circle.py record FOLDER`` runs a loop and exports its journal; then `loopwright new` and
`loopwright run` make a controller of it; ``python tests/closed_circle.py swap FOLDER CONTROLLER`` swaps it in.
"""

from __future__ import annotations

import random
import sys
from pathlib import Path

from plant_servers import Plant, RunningLoop
from processes import within

from pipeline.__main__ import main
from serving.station.control import ask

CASE, LAW = "ph_neutralization", "pid"
SPEED = 1200.0  # a period of 60 s in 50 ms
ROWS = 1_500


def begun(folder: Path) -> tuple[Plant, RunningLoop]:
    """The plant and its loop, in AUTO."""
    folder.mkdir(parents=True, exist_ok=True)
    plant = Plant(folder, CASE, SPEED, "--noise")
    plant.start()
    path = folder / "loop.toml"
    path.unlink(missing_ok=True)
    file = Path("artifacts", CASE, f"{LAW}.onnx")
    assert main(["loop", "init", str(file), "--endpoint", plant.endpoint, "--out", str(path)]) == 0
    text = path.read_text().replace('page = "127.0.0.1:8080"', f"speed = {SPEED}").replace("SHADOW", "AUTO", 1)
    path.write_text(text.replace("max_age_s = 90", "max_age_s = 1200"))
    return plant, RunningLoop(path)


def record(folder: Path) -> None:
    """Set points that move now and then, and the journal as an export."""
    plant, loop = begun(folder)
    rng, journal = random.Random(0), loop.settings.journal.file
    try:
        while loop.station.scans < ROWS:
            ask(journal, {"do": "sp", "value": {"pH": rng.uniform(6.6, 8.8)}, "who": "engineer"})
            until = loop.station.scans + rng.randint(5, 40)
            assert within(60, lambda: loop.station.scans >= until)  # noqa: B023
    finally:
        loop.end()
        plant.end()
    assert main(["loop", "export", str(journal), "--out", str(folder / "loop.csv")]) == 0


def swap(folder: Path, controller: Path) -> None:
    """The new controller takes over, and holds a set point."""
    plant, loop = begun(folder / "swap")
    journal = loop.settings.journal.file
    try:
        ask(journal, {"do": "sp", "value": {"pH": 7.2}, "who": "engineer"})
        ask(journal, {"do": "swap", "value": {"file": str(controller.absolute()), "trial": 40}, "who": "engineer"})
        assert within(60, lambda: loop.station.loop is not None and loop.station.loop.replaced is not None)
        ask(journal, {"do": "sp", "value": {"pH": 7.6}, "who": "engineer"})

        def held() -> bool:
            now = ask(journal, {"do": "state"})
            return now["mode"] == "AUTO" and now["pv"] is not None and abs(now["pv"][0] - 7.6) < 0.15

        assert within(60, held), ask(journal, {"do": "state"})
    finally:
        loop.end()
        plant.end()
    print(f"closed circle: {controller} has the plant, and holds its set point")


if __name__ == "__main__":
    if sys.argv[1] == "record":
        record(Path(sys.argv[2]))
    else:
        swap(Path(sys.argv[2]), Path(sys.argv[3]))
