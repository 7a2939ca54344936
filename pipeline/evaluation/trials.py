"""Trials of exported files over every test of their case, in pieces small enough to fill a cluster."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

from loopwright.pipeline.engine.parallel import parallel_map
from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.evaluation.law_evidence import BASE, Cycle
from loopwright.pipeline.evaluation.metric import together
from loopwright.pipeline.evaluation.reached import reached_by, widest
from loopwright.pipeline.evaluation.trial import DEVELOPED, DEVELOPMENT, Metrics, Trial, repeated
from loopwright.pipeline.simulation.scenario import NOISE_SUFFIX, Scenario
from loopwright.pipeline.simulation.simulate import Trajectory
from loopwright.serving.controller import Controller

Kind = Literal["scored", "development", "shown"]


@dataclass(frozen=True)
class Piece:
    """The smallest part of a trial: one sequence of one test."""

    form: str
    seed: int
    path: Path
    kind: Kind
    test: str
    place: int
    noise: bool = False

    @property
    def key(self) -> str:
        """The name of the figures, and of the curve."""
        return self.test + (NOISE_SUFFIX if self.noise else "")


@dataclass(frozen=True)
class Ran:
    """The result of a piece; the first sequence of a test alone brings its curve."""

    info: tuple[str, ...]
    metrics: Metrics
    lock_ups: int
    swings: int
    beyond_reach: int
    curve: Trajectory | None
    reached: dict[str, tuple[float, float]] | None
    cycle: tuple[Cycle, Trajectory] | None  # of a scored test


class Trials:
    """Trials of files over a case's tests; the shipped form also runs the development sequences.

    Variants run the tests in ``variants_run``, with noise only if development has noise too.
    """

    def __init__(self, case: Case, noise_seed: int) -> None:
        self.case, self.noise_seed = case, noise_seed
        self._opened: tuple[Path, Controller] | None = None  # pieces of one file come one after the other

    @cached_property
    def sequences(self) -> dict[Kind, Mapping[str, tuple[Scenario, ...]]]:
        """The sequences of each test, computed once a process: their steady states take their time."""
        shown = {name: (test,) for name, test in self.case.unscored().items()}
        return {"scored": self.case.scenarios(), "shown": shown, DEVELOPED: {DEVELOPED: self.case.development()}}

    def pieces(self, form: str, seed: int, path: Path) -> list[Piece]:
        """The pieces of the trial of one file."""
        found = list[Piece]()
        for kind, tests in self.sequences.items():
            for name, sequences in tests.items():
                if form != BASE and (kind == DEVELOPED or (kind == "scored" and not self.case.variants_run(sequences))):
                    continue
                for noise in self._noises(form, kind):
                    if noise and sequences[0].replayed:
                        continue
                    found += [Piece(form, seed, path, kind, name, i, noise) for i in range(len(sequences))]
        return found

    def _noises(self, form: str, kind: Kind) -> tuple[bool, ...]:
        if kind == DEVELOPED:
            return (self.case.development_noise,)
        return (False, True) if kind == "scored" and (form == BASE or self.case.development_noise) else (False,)

    def run(self, piece: Piece) -> Ran:
        """The closed loops of a piece."""
        test, case = self.sequences[piece.kind][piece.test][piece.place], self.case
        controller, seed = self._controller(piece.path), self.noise_seed + piece.place
        if piece.kind == DEVELOPED:
            seed += DEVELOPMENT
        one = repeated(controller, case, test, piece.noise, seed)
        # A plant gone wrong may overshoot far on a model that is a straight line: such figures say nothing of ranges.
        told = piece.kind == "scored" and not piece.noise and piece.test not in case.gone_wrong
        reached = reached_by([one.first], case) if case.on_models and told else None
        kept = piece.kind != DEVELOPED and piece.place == 0
        counts = one.lock_ups, one.swings, one.beyond_reach
        cycle = (one.cycle, one.first) if one.cycle is not None and piece.kind == "scored" else None
        return Ran(controller.manifest.info, one.metrics, *counts, one.first if kept else None, reached, cycle)

    def weight(self, piece: Piece) -> float:
        """The cost of a piece beside others: its samples."""
        samples = self.sequences[piece.kind][piece.test][piece.place].samples
        return float(samples * (self.case.noise_draws if piece.noise else 1))

    def trial(self, found: Mapping[Piece, Ran]) -> Trial:
        """The trial of one file from its pieces, which are in their order."""
        metrics, locked_up, swings, beyond = dict[str, Metrics](), dict[str, int](), dict[str, int](), dict[str, int]()
        curves, sequences = dict[str, Trajectory](), dict[str, dict[str, Metrics]]()
        for piece, ran in found.items():
            locked_up[piece.key] = locked_up.get(piece.key, 0) + ran.lock_ups
            swings[piece.key] = swings.get(piece.key, 0) + ran.swings
            beyond[piece.key] = beyond.get(piece.key, 0) + ran.beyond_reach
            if ran.curve is not None:
                curves[piece.key] = replace(ran.curve, info=ran.curve.info[:, :-1])
            if piece.kind != "scored" or piece.key in metrics:
                continue
            rows = [r.metrics for p, r in found.items() if (p.kind, p.key) == (piece.kind, piece.key)]
            metrics[piece.key] = together(rows, self.case.metrics)
            if len(rows) > 1 and not piece.noise:
                tests = self.sequences[piece.kind][piece.test]
                sequences[piece.test] = {str(t.seed): row for t, row in zip(tests, rows, strict=True)}
        developed = [r.metrics[self.case.metric] for p, r in found.items() if p.kind == DEVELOPED]
        first, ran = next(iter(found.items()))
        # Of each test the worst comes last; of all, on plants gone wrong where there is no other.
        cycles = sorted(
            ((*r.cycle, p.key) for p, r in found.items() if r.cycle is not None),
            key=lambda c: (c[2] not in self.case.gone_wrong, c[0].times),
        )
        return Trial(
            first.form,
            first.seed,
            ran.info,
            metrics,
            sequences,
            self.case.developed(developed),
            {name: count for name, count in locked_up.items() if count},
            {name: count for name, count in swings.items() if count},
            {name: count for name, count in beyond.items() if count},
            curves,
            widest(r.reached for r in found.values() if r.reached is not None),
            {key: cycle for cycle, _, key in cycles},
            cycles[-1][1] if cycles else None,
        )

    def _controller(self, path: Path) -> Controller:
        if self._opened is None or self._opened[0] != path:
            self._opened = path, Controller(path)
        return self._opened[1]


def try_files(case: Case, noise_seed: int, files: Sequence[tuple[str, int, Path]], label: str) -> list[Trial]:
    """The trials of several files, each of a (form, data seed), under a label for their progress."""
    trials = Trials(case, noise_seed)
    each = [trials.pieces(*file) for file in files]
    work = [piece for pieces in each for piece in pieces]
    ran = parallel_map(trials.run, work, label, [trials.weight(piece) for piece in work], in_folder=True)
    found = iter(ran)
    return [trials.trial({piece: next(found) for piece in pieces}) for pieces in each]
