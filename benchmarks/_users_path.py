"""The path of a user: an export file, `loopwright new`, and of `loopwright run` the stages that lead to models."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from _free_run import Part, Predictor
from _project import fresh_project, run_module

from loopwright.pipeline.models import load_model
from loopwright.pipeline.models.identified.dynamics import Dynamics
from loopwright.pipeline.models.identified.identified import Identified


@dataclass(frozen=True, slots=True)
class Answer:
    """What `loopwright new` says of an export: its verdict, why it refuses (empty: it does not), and all its lines."""

    verdict: str
    refused: str
    lines: Sequence[str]


class Project:
    """A fresh folder with the sources of the product, as a user has it; the commands run in it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        fresh_project(folder)

    def new(self, name: str, learn: Part, period_s: float, *, keep: bool = False, anyway: bool = False) -> Answer:
        """`loopwright new` of the rows to learn; ``keep``: y ends where the plant does, said in the table of tags.

        `--period` asks for the rows as they are: the rules of the benchmarks count each.
        """
        file = f"{name}.csv"
        rows = np.column_stack([period_s * np.arange(len(learn.y)), learn.y, learn.u])
        np.savetxt(self.folder / file, rows, delimiter=",", header="time_s,y,u", comments="", fmt="%.10g")
        tags = ["--pv", "y", "--mv", "u"]
        if keep:
            (self.folder / f"{name}-tags.csv").write_text("tag,role,ends\ny,pv,keep\nu,mv,\n")
            tags = ["--tags", f"{name}-tags.csv"]
        period = ["--period", f"{period_s:.10g}"]
        code, lines = self._run("loopwright.pipeline", "new", name, file, *tags, *period, *["--anyway"] * anyway)
        said = next((line.rpartition(": ")[2] for line in lines if line.startswith("can these data carry")), "none")
        why = next((line.partition("params.yaml: ")[2] for line in lines if "was not added" in line), "")
        return Answer(said, (why or lines[-1]) if code else "", lines)

    def model(self, name: str, seed: int) -> tuple[Predictor | None, str]:
        """The model that `loopwright run` fits with this seed, or None and the words of its failure.

        Seed 0 is what `new` wrote into params.yaml. Another seed is a folder of data whose file has its number.
        """
        data = Path("work") / name / "records" / "screened" / "record.parquet"
        if seed:
            if not (self.folder / data).exists():
                self._run("loopwright.pipeline.engine.start", "screen", name)
            own = Path("data") / name / f"of_seed{seed}"
            (self.folder / own).mkdir(exist_ok=True)
            shutil.copy(self.folder / data, self.folder / own / f"seed{seed}.parquet")
            data = own
        self._learn_from(name, data)
        code, lines = self._run("loopwright.pipeline", "run", f"{name}-identified")
        if code:
            return None, lines[-1]
        models = self.folder / "work" / name / "models" / "identified"
        metrics = json.loads((models / "metrics.json").read_text())["parts"]["identified"]["per_seed"][str(seed)]
        model = load_model(models / f"seed{seed}" / "identified.npz")
        assert isinstance(model, Identified)
        return predictor_of(model, metrics["structure"]), ""

    def _learn_from(self, name: str, data: Path) -> None:
        """Change ``models.NAME-identified.data`` of params.yaml, a line of its own."""
        path = self.folder / "params.yaml"
        section, found = re.subn(
            rf"(?m)(^  {name}-identified:\n(?:    .*\n)*?    data: ).*$", rf"\g<1>{data.as_posix()}", path.read_text()
        )
        assert found == 1, f"{path} has {found} entries {name}-identified with data"
        path.write_text(section)

    def _run(self, module: str, *words: str) -> tuple[int, list[str]]:
        """Exit status of a command of the product and the lines that it printed, which are kept."""
        code, lines = run_module(self.folder, module, *words)
        with (self.folder / "said.txt").open("a", encoding="utf-8") as log:
            log.write("\n".join([*lines, ""]))
        return code, lines


def predictor_of(model: Identified, structure: Mapping[str, Any]) -> Predictor:
    """A fitted model of one input and one output, to be run over test rows."""
    of = {name: np.array(value.numpy()) for name, value in model.state_dict().items()}
    dynamics = Dynamics(*(of[name] for name in ("a", "b", "c", "w1", "b1", "w2")))
    y, u = ((float(of[f"{signal}_center"][0]), float(of[f"{signal}_scale"][0])) for signal in ("y", "v"))
    words = f"{structure['start']}, {structure['order']} states, {structure['hidden']} units, by {structure['judged']}"
    return Predictor(dynamics, y, u, structure["same_row"], words)
