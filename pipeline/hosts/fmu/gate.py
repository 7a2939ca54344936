"""A controller FMU compared with its controller over the conformance kit's steps: the same bits, or no FMU."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np

from loopwright.pipeline.errors import HostError
from loopwright.pipeline.hosts.fmu.folder import ScalarVariable, variables_of
from loopwright.pipeline.plants.fmu.description import described, fmpy
from loopwright.pipeline.plants.fmu.instance import Instance
from loopwright.serving.conformance.steps import answered
from loopwright.serving.controller import Controller


def check(controller: Controller, fmu: Path, folder: Path) -> int:
    """Play the kit's steps through the FMU, which lies unpacked in ``folder``; how many were compared.

    A refused step must hold the last MV and info and leave the state as it was, which the steps after it show.
    Raises HostError where a number differs by a bit, PlantError where the FMU cannot be loaded or refuses a call.
    """
    rows, period = variables_of(controller.manifest), controller.manifest.period_s
    mv, info = _references(rows, "mv"), _references(rows, "info")
    groups = [name for name in controller.manifest.inputs if name != "state"]
    given_to = [reference for name in groups for reference in _references(rows, name)]
    instance, expected, k = Instance(described(fmu), folder), np.zeros(0), 0
    steps = answered(controller)
    for number, answer in enumerate(steps):
        if answer.given.cold:
            instance.begin()
            k = 0
        values = np.concatenate([answer.given.inputs[name] for name in groups])
        instance.step(given_to, values, k * period, period)
        k += 1
        if answer.step is not None:
            expected = np.concatenate([answer.step.mv, answer.step.info])
        found = instance.get([*mv, *info])
        if found.tobytes() != expected.tobytes():
            raise HostError(
                f"the FMU differs from {controller.path} in step {number} of the conformance kit: "
                f"{found.tolist()} instead of {expected.tolist()}; nothing is written"
            )
    return len(steps)


def problems(fmu: Path) -> list[str]:
    """Faults of an FMU by fmpy: its XML against FMI's schema, names, units, the structure of its outputs."""
    fmpy()
    validation = importlib.import_module("fmpy.validation")
    return list(validation.validate_fmu(str(fmu)))


def _references(rows: list[ScalarVariable], group: str) -> list[int]:
    return [row.reference for row in rows if row.group == group]
