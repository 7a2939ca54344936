"""The thiosulfate CSTR's tests: set points over the whole range, disturbances at the unstable point."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from loopwright.pipeline.cases.thiosulfate_cstr.plant import ThiosulfateCstr
from loopwright.pipeline.evaluation.case import (
    Array,
    Case,
    Curve,
    Figure,
    PaperFigure,
    PaperTable,
    Requirement,
    Setting,
)
from loopwright.pipeline.pictures.words import law_label, setting_text
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.simulation.scenario import Scenario, held, random_levels

TJ = 250.0  # [K] of the three steady states
HOLD = 80
SP_A = [0.6661, 0.0755, 0.6661, 0.9872, 0.0755, 0.9872, 0.6661]
SP_B = [0.0755, 0.2, 0.35, 0.5, 0.6661, 0.8, 0.9, 0.96, 0.7, 0.45, 0.15, 0.0755]
HELD_OUT_LEVELS, HELD_OUT_HOLD, HELD_OUT_RANGE = 16, 60, (0.03, 0.985)
DISTURBANCE_SAMPLES = 350
UA, UA_LOW, UA_RATE = 20_000.0, 10_000.0, 40.0  # [J/(s K)], the rate a sample


def _table(number: int, title: str, test: str, *rows: tuple[str, Setting, str, float]) -> PaperTable:
    return PaperTable(
        number,
        title,
        tuple(
            PaperFigure(law_label(law, setting_text(setting)), law, test, metric, value, setting)
            for law, setting, metric, value in rows
        ),
    )


def _r(value: float) -> dict[str, float]:
    return {"r": value}


_DISTURBED = (Curve("inc"), Curve("incad", _r(10)), Curve("incadec", _r(10)), Curve("pid"))


@dataclass(frozen=True)
class ThiosulfateCstrCase(Case):
    """[inverse_rbf, section 4], made precise where the paper shows only a curve.

    The paper's set-point test is taken as SP-A. Disturbances act from the first period on, so that
    all 350 samples see them; in the gradual test UA falls by 40 J/(s K) before every period but the
    first, reaches 10,000 at sample 250, as printed, and stays.
    """

    held_out_seeds: tuple[int, ...] = (9001, 9002, 9003, 9004, 9005)

    name: ClassVar[str] = "thiosulfate_cstr"
    disclosure: ClassVar[str] = (
        "The figures of `sp_a` and `ua` influenced the horizon, widths and partitions of three_periods. "
        "`held_out` influenced no setting."
    )
    title: ClassVar[str] = "Thiosulfate CSTR"
    plant_class: ClassVar[type[EquationPlant]] = ThiosulfateCstr
    test_words: ClassVar[Mapping[str, str]] = {"sp_a": "SP-A", "sp_b": "SP-B"}
    development_seeds: ClassVar[tuple[int, ...]] = (11, 12, 13)
    noise: ClassVar[Mapping[str, float]] = {"C_A": 5e-4, "T": 0.1}
    gate: ClassVar[Mapping[str, float]] = {"sp_a": 0.2, "sp_b": 0.2, "held_out": 0.4, "tin": 0.1, "ua": 0.1}
    tables: ClassVar[tuple[PaperTable, ...]] = (
        _table(
            2,
            "Set-point tracking",
            "sp_a",
            ("incad", _r(2.5), "mae", 0.079),
            ("inc", {}, "mae", 0.2),
            ("pid", {}, "mae", 0.214),
        ),
        _table(
            3,
            "Impact of the narrowing parameter r",
            "sp_a",
            ("incad", _r(1.5), "mae", 0.134),
            ("incad", _r(2.5), "mae", 0.079),
            ("incad", _r(3.5), "mae", 0.096),
            ("incad", _r(4.5), "mae", 0.116),
        ),
        _table(
            4,
            "Impact of the error-correcting term",
            "sp_a",
            ("incad", _r(4.5), "mae", 0.116),
            ("incad", _r(4.5), "max_asse", 0.002),
            ("incad", _r(4.5), "masse", 0.0005),
            ("incadec", _r(5.5), "mae", 0.124),
            ("incadec", _r(5.5), "max_asse", 0.0),
            ("incadec", _r(5.5), "masse", 0.0),
        ),
        _table(
            5,
            "Unmeasured disturbance: inlet temperature 275 to 305 K",
            "tin",
            ("incadec", _r(10), "mae", 0.0005),
            ("incad", _r(10), "mae", 0.0575),
            ("inc", {}, "mae", 0.2916),
            ("pid", {}, "mae", 0.0034),
        ),
        _table(
            6,
            "Process uncertainty: UA halved at once",
            "ua",
            ("incadec", _r(10), "mae", 0.0003),
            ("incad", _r(10), "mae", 0.0394),
            ("inc", {}, "mae", 0.4259),
            ("pid", {}, "mae", 0.0018),
        ),
        _table(
            7,
            "Process uncertainty: UA falling by 40 a sample to a half",
            "ua_gradual",
            ("incadec", _r(10), "mae", 0.00005),
            ("incad", _r(10), "mae", 0.02142),
            ("inc", {}, "mae", 0.01257),
            ("pid", {}, "mae", 0.0004),
        ),
    )
    figures: ClassVar[tuple[Figure, ...]] = (
        Figure(5, "The inverse model's prediction over validation data", (Curve("inc"),)),
        Figure(6, "Set-point tracking", (Curve("inc"), Curve("incad", _r(2.5)), Curve("pid")), "sp_a"),
        Figure(
            7, "Set-point tracking, each set point held longer", (Curve("incad", _r(2.5)), Curve("pid")), "sp_a_hold160"
        ),
        Figure(8, "The narrowing parameter r", tuple(Curve("incad", _r(r)) for r in (1.5, 2.5, 3.5, 4.5)), "sp_a"),
        Figure(9, "Inlet temperature 275 to 305 K, unmeasured", _DISTURBED, "tin"),
        Figure(10, "UA halved at once", _DISTURBED, "ua"),
        Figure(11, "UA falling by 40 a sample to a half", _DISTURBED, "ua_gradual"),
    )
    requirements: ClassVar[tuple[Requirement, ...]] = (
        Requirement("inc", "sp_a", "mae", 0.18, low=0.15),
        Requirement("incad", "sp_b", "mae", 0.018, setting=_r(1.5)),
        Requirement(None, "sp_a", "mae", 1.20, times="offline"),
        Requirement(None, "sp_b", "mae", 1.30, times="offline"),
        Requirement(None, "held_out", "mae", 1.20, times="nmpc"),
        Requirement(None, "sp_a", "max_asse", 1e-3),
        Requirement(None, "sp_b", "max_asse", 1e-3),
        Requirement(None, "held_out", "masse", 1e-3),
        Requirement(None, "held_out", "max_asse", 1e-3),
        Requirement(None, "tin", "max_asse", 1e-3),
        Requirement(None, "ua", "max_asse", 1e-3),
        Requirement(None, "ua_gradual", "max_asse", 1e-3),
        Requirement(None, "tin", "mae", 1e-3),
        Requirement(None, "ua", "mae", 1e-3),
        Requirement(None, "ua_gradual", "mae", 5e-4),
    )

    @property
    def regions(self) -> Mapping[str, tuple[float, float]]:
        """The plant's three, by the names that its literature uses."""
        return dict(zip(("hot", "middle", "cold"), self.plant.regions.values(), strict=True))

    @cached_property
    def _steady(self) -> dict[str, Array]:
        return dict(zip(("hot", "middle", "cold"), self.equations.steady_states(TJ), strict=True))

    def _tracking(
        self, name: str, title: str, start: str, levels: list[float], hold: int, seed: int | None = None
    ) -> Scenario:
        return Scenario(name, title, held(levels, hold), self._steady[start], np.array([TJ]), {}, hold, seed)

    def _disturbance(self, name: str, title: str, **changes: Array | float) -> Scenario:
        n = DISTURBANCE_SAMPLES
        x0 = self._steady["middle"]
        full = {
            key: np.broadcast_to(np.asarray(value, dtype=np.float64), (n,)).copy() for key, value in changes.items()
        }
        return Scenario(name, title, np.full((n, 1), x0[0]), x0, np.array([TJ]), full)

    def _random(self, name: str, seed: int) -> Scenario:
        levels = random_levels(seed, HELD_OUT_LEVELS, *HELD_OUT_RANGE)
        return self._tracking(name, f"Random set points, seed {seed}", "hot", levels, HELD_OUT_HOLD, seed)

    def scenarios(self) -> dict[str, tuple[Scenario, ...]]:
        """sp_a, sp_b, tin, ua, ua_gradual (one scenario each) and held_out (one a seed)."""
        falling = np.maximum(UA - UA_RATE * np.arange(DISTURBANCE_SAMPLES), UA_LOW)
        found = (
            self._tracking("sp_a", "Set points between the three steady states", "cold", SP_A, HOLD),
            self._tracking("sp_b", "Set points over the whole range", "hot", SP_B, HOLD),
            self._disturbance("tin", "Inlet temperature 275 to 305 K", T_in=305.0),
            self._disturbance("ua", "UA halved at once", UA=UA_LOW),
            self._disturbance("ua_gradual", "UA falling by 40 a sample to a half", UA=falling),
        )
        fixed = {scenario.name: (scenario,) for scenario in found}
        return {**fixed, "held_out": tuple(self._random("held_out", seed) for seed in self.held_out_seeds)}

    def unscored(self) -> Mapping[str, Scenario]:
        """sp_a_hold160: SP-A, each set point held twice as long, as Figure 7 shows it."""
        return {"sp_a_hold160": self._tracking("sp_a_hold160", "SP-A, held longer", "cold", SP_A, 2 * HOLD)}

    def development(self) -> tuple[Scenario, ...]:
        """Random sequences of other seeds, the extremes (where a poor inverse locks up), other disturbances."""
        extremes = [0.985, 0.03, 0.985, 0.5, 0.03, 0.8, 0.985, 0.03]
        return (
            *(self._random("development", seed) for seed in self.development_seeds),
            self._tracking("extremes", "From end to end", "hot", extremes, HELD_OUT_HOLD),
            self._disturbance("tin_down", "Inlet temperature 275 to 260 K", T_in=260.0),
            self._disturbance("ua_up", "UA up by 30 %", UA=26_000.0),
        )
