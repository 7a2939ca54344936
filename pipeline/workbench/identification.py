"""A model of a plant for notebooks: its structure searched as stage ``fit`` does, and what speaks against it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import nan
from typing import Any

import numpy as np
import pandas as pd

from loopwright.pipeline.cases.own_model import LAW_PART, MODEL_ARRAYS, OwnPlant
from loopwright.pipeline.config.known import Known
from loopwright.pipeline.evaluation.proof import fit_doubts, sign_doubts, wants_a_plainer_model
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.models.identified.identified_part import IdentifiedPart
from loopwright.pipeline.models.identified.network_search import UNITS
from loopwright.pipeline.models.identified.structure_search import Searched
from loopwright.pipeline.models.part import Source
from loopwright.pipeline.records.record import Record
from loopwright.pipeline.workbench.plant_data import NOTEBOOK, PlantData, signals_of


@dataclass(frozen=True, eq=False)
class Identification:
    """A model of the plant, what its fit found (``figures``), and what speaks against it (``doubts``, else empty)."""

    model: Identified
    data: PlantData
    figures: Mapping[str, Any]
    doubts: str

    @property
    def gains(self) -> pd.DataFrame:
        """A row each pair: gain [PV/input], its spread, sign, lowest and highest gain, dead time [s].

        The dead time is the model's own, NaN where the input moves nothing.
        """
        first, period_s = self.figures["first_answers"], self.data.record.period_s
        rows = [
            {"pv": pv, "input": name, **{k: of[k] for k in ("gain", "spread", "sign", "low", "high")}}
            | {"dead_time_s": nan if (k := first[pv][name]) is None else (k - 1) * period_s}
            for pv, inputs in self.figures["gains"].items()
            for name, of in inputs.items()
        ]
        return pd.DataFrame(rows).set_index(["pv", "input"])

    @cached_property
    def plant(self) -> OwnPlant:
        """The model as a plant, with its noise, that begins at rest at the medians of the record's inputs."""
        return self.plant_later(0.0)

    def plant_later(self, periods: float) -> OwnPlant:
        """The same, whose parameter ``dead_time`` may be so many periods: in ``plant`` what the record leaves open."""
        arrays = {name: np.asarray(getattr(self.model, name)) for name in MODEL_ARRAYS}
        mv, dv = (np.median(values, axis=0) for values in (self.data.record.mv, self.data.record.dv))
        plant = OwnPlant.of_model(arrays, self.data.signals, name=NOTEBOOK, mv=mv, dv=dv, dead=periods)
        vars(plant).update(title="the model")  # its runs are told from those of the plant itself
        return plant


def identify(
    data: PlantData | Record,
    *,
    minutes: float | None = None,
    linear: bool = False,
    known: Sequence[Known] = (),
    seed: int = 0,
) -> Identification:
    """The model of a record, its structure searched as stage ``fit`` does.

    A network that the record does not prove gives way to the linear model where the record proves that one.

    Parameters
    ----------
    data
        Readings that were screened, or any record.
    minutes
        Budget of the search, in minutes of one core; None: 2 for each output.
    linear
        Linear models alone.
    known
        What an engineer knows of pairs of PV and input.
    seed
        Of the networks' starts.

    Raises
    ------
    ModelError
        The record cannot carry a model: too short, or an input that never moves.
    """
    if isinstance(data, Record):
        data = PlantData(data, signals_of(data), {})
    part = IdentifiedPart(minutes=minutes, units=() if linear else UNITS)
    source = Source(data.record, data.signals, seed=seed, known=tuple(known), held=data.held)
    work = part.groundwork()
    searched = work.done(source, work.kind)
    model, figures = _learnt(part, source, searched)
    plain = work.plainer(searched)
    if plain is not None and wants_a_plainer_model(_as_set(figures)):
        other, found = _learnt(part, source, plain)
        if not (sign_doubts(_as_set(found)) or fit_doubts(_as_set(found))):
            model, figures = other, found
    return Identification(model, data, figures, sign_doubts(_as_set(figures)))


def _learnt(part: IdentifiedPart, source: Source, searched: Searched) -> tuple[Identified, dict[str, Any]]:
    learnt = part.learn(replace(source, groundwork={part.groundwork(): searched}))
    assert isinstance(learnt.model, Identified)
    return learnt.model, learnt.metrics


def _as_set(figures: Mapping[str, Any]) -> dict[str, Any]:
    """The figures of a model as those who judge the proof read them, in a set of models."""
    return {"": {"parts": {LAW_PART: {"kind": "identified", "per_seed": {"0": figures}}}}}
