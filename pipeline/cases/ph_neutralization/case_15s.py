"""The pH neutralization sampled every 15 s: the same tests, four samples for one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from loopwright.pipeline.cases.ph_neutralization.case import ASKED_OF_THE_BEST, PhNeutralizationCase
from loopwright.pipeline.cases.ph_neutralization.plant import PhNeutralization15s
from loopwright.pipeline.evaluation.case import Figure, PaperTable, Requirement
from loopwright.pipeline.plants.equations import EquationPlant


@dataclass(frozen=True)
class PhNeutralization15sCase(PhNeutralizationCase):
    """The paper does not print its period; its figures fit 60 s, and this shows what a shorter one gains."""

    name: ClassVar[str] = "ph_neutralization_15s"
    title: ClassVar[str] = "pH neutralization, sampled every 15 s"
    plant_class: ClassVar[type[EquationPlant]] = PhNeutralization15s
    tables: ClassVar[tuple[PaperTable, ...]] = ()
    figures: ClassVar[tuple[Figure, ...]] = ()
    requirements: ClassVar[tuple[Requirement, ...]] = ASKED_OF_THE_BEST
