"""Random operators, readings and faults on predictive laws with ``operate``, through the exported file and the loop.

``python benchmarks/operate_fuzz.py [--scans N] [--first SEED] [--folder DIR] [--law-by auto|c|onnx]``. Each history has
a seed, one of the laws below, a plant that differs from its model, and 200 scans of the real ``ControlLoop`` with the
real guards on a clock that does not wait. At random scans somebody changes ``operate``, set points, MVs, the mode or
the controller; readings are bad, missing, frozen, jumped, late or not new; MVs go local; answers and writes fail;
periods are missed. Counted are commands outside an MV's range or faster than its rate, moves of an MV that is not the
law's to move, steps that are refused, numbers that are not finite, and exceptions. A history that shows one is printed
with its seed; ``--first SEED --scans 200`` runs it again.

Most of the time was onnxruntime's, 1 ms a step: the compiled plain C of a file takes its place, as in ``stress``, where
each step of the file's conformance kit agrees within 1e-9.

``--folder`` keeps the laws' files, and the counts after each hundred histories: a run that was ended goes on there.
"""

from __future__ import annotations

import argparse
import json
import logging
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _fuzzed_plants import KINDS, Findings, MadePlant, Watched, WatchedGuard, laws_of
from numpy.typing import NDArray

from loopwright.pipeline.export.plain_code.compiled_law import LAW_BY
from loopwright.serving import Fallback, Frozen, Guard, LoopError, Rate, Sample, VirtualClock, default_guards
from loopwright.serving.guard import kind_of
from loopwright.serving.loop import Command, ControlLoop
from loopwright.serving.manifest import SWITCHES, Manifest
from loopwright.serving.operating import Operate

SCANS = 200  # of a history
KEPT = 100  # histories between two writings of the counts


# ---------------------------------------------------------------------------------------------------------- a history
class History:
    """One seed: a loop over a plant, and somebody who changes something at random scans."""

    def __init__(self, seed: int, laws: Callable[[int], Sequence[Watched]]) -> None:
        self.rng = rng = np.random.default_rng(seed)
        number = seed % len(KINDS)
        self.findings, self.laws = Findings(), laws(number)
        self._known = Operate(())
        self._sent = np.zeros(0, dtype=bool)  # shape: (n_mv,), sent by hand in this period
        for law in self.laws:
            law.findings = self.findings
        self.plant = MadePlant(KINDS[number], 100 * number, rng, self.findings)
        self.clock = VirtualClock()
        first, m = self.laws[0], self.laws[0].manifest
        self.guarded, self.strict = rng.random() < 0.8, rng.random() < 0.5
        fallback = None
        if rng.random() < 0.4:
            wanted, rate = tuple(s.middle for s in m.mv), tuple(0.03 * (s.high - s.low) for s in m.mv)
            fallback = Fallback(float(rng.choice([0.0, 5.0])), wanted, rate)
        self.plant.held = fallback is None
        known = self.plant.at.copy() if not self.plant.reads_back or rng.random() < 0.5 else None
        self.loop = ControlLoop(
            first, self.plant, sp=[0.0] * len(m.sp), mv=known, mode=str(rng.choice(["AUTO", "MANUAL", "SHADOW"])),
            guards=self._guards, recover_after=int(rng.choice([1, 5])), clock=self.clock, warm_lead_s=0.0,
            transfer_s=float(rng.choice([0.0, 10.0])), fallback=fallback, bridge_s=float(rng.choice([0.0, 3.0, 10.0])),
            critical=[m.pv[0].name] if rng.random() < 0.2 else [],
        )  # fmt: skip
        self.plant.mode = lambda: self.loop.mode
        self.plant.theirs = self._theirs
        self.plant.written = known

    def run(self, scans: int = SCANS) -> Findings:
        """All scans; an exception ends the history."""
        try:
            report = self.loop.run(scans, before=self._before, observe=self._observe)
        except Exception as error:
            self.findings.add("exception in the loop", f"{type(error).__name__}: {error}")
            return self.findings
        if report.errors:
            self.findings.add("exception beside the loop", "; ".join(report.first_errors))
        return self.findings

    def _guards(self, manifest: Manifest) -> Sequence[Guard]:
        found: list[Guard] = list(default_guards(manifest)) if self.guarded else []
        if self.strict:
            found += [Frozen(manifest.pv, 5), Rate(manifest.pv, tuple(1.0 for _ in manifest.pv))]
        return tuple(WatchedGuard(guard, self.findings) for guard in found)

    def _before(self, k: int) -> None:
        rng, plant = self.rng, self.plant
        self.findings.scan = k
        self._sent = np.zeros(len(plant.local), dtype=bool)
        try:
            for act, chance in (
                (self._operate, 0.15), (self._sp, 0.05), (self._mode, 0.03), (self._hand, 0.05), (self._swap, 0.01),
                (self._local, 0.02),
            ):  # fmt: skip
                if rng.random() < chance:
                    self.findings.seen[act.__name__.removeprefix("_")] += 1
                    try:
                        act()
                    except LoopError:
                        self.findings.seen["refused change"] += 1
        except Exception as error:
            self.findings.add("exception in a change", f"{type(error).__name__}: {error}")
        if rng.random() < 0.01:
            plant.deaf = int(rng.integers(0, 6))
        if rng.random() < 0.01:
            plant.silent = int(rng.integers(0, 6))

    @property
    def _operated(self) -> Operate:
        """Of the law in charge, made once for each that takes over."""
        entries = self.loop.controller.manifest.operate
        if self._known.entries is not entries:
            self._known = Operate(entries)
        return self._known

    def _theirs(self) -> NDArray[np.bool_]:
        """The MVs (n_mv,) that may move in HOLD: in hand, sent by hand this period and given back, or the plant's."""
        loop, at = self.loop, self._operated.places
        used = [loop.operate[at[f"{s.name}.use"]] if f"{s.name}.use" in at else 1.0 for s in loop.manifest.mv]
        out = [s.name in loop.local or not u for s, u in zip(loop.manifest.mv, used, strict=True)]
        return np.array(out) | self._sent

    def _observe(self, sample: Sample | None, command: Command) -> None:
        seen, plant = self.findings.seen, self.plant
        seen[f"scans in {command.mode.value}"] += 1
        seen["scans bridged"] += bool(command.bridged)
        seen["scans shed"] += bool(command.shed)
        if command.fault:
            self.findings.faults[kind_of(command.fault)[0]] += 1
        if command.law_mv is not None and not np.isfinite(command.law_mv).all():
            self.findings.add("law's MV not finite")
        if command.writes and not np.isfinite(command.mv).all():
            self.findings.add("command not finite")
        plant.advance()
        if self.rng.random() < 0.01:
            self.clock.advance(float(self.rng.integers(1, 8)))

    # ------------------------------------------------------------------ changes
    def _operate(self) -> None:
        """Some entries at once: within their ranges, at an end, or (seldom) wrong."""
        rng, operate = self.rng, self._operated
        entries = operate.entries
        if not entries:
            self.loop.set_operate({"u0.use": 0})
            return
        found, base = dict[str, float](), self.loop.operate
        for i in rng.choice(len(entries), size=min(len(entries), int(rng.integers(1, 6))), replace=False).tolist():
            e = entries[i]
            if e.what in SWITCHES:
                value = float(rng.integers(0, 2)) if e.low < e.high else e.low
            else:
                value = float(rng.choice([rng.uniform(e.low, e.high), e.low, e.high, e.default, base[i]]))
            found[e.name] = value if rng.random() > 0.01 else float(rng.choice([np.nan, np.inf, e.high + 1, e.low - 1]))
        for e in entries:  # both ends of a range, most of the time in order
            if e.what == "low" and rng.random() < 0.9:
                ends = [f"{e.signal}.low", f"{e.signal}.high"]
                if set(ends) & set(found):
                    both = sorted(found.get(n, float(base[operate.places[n]])) for n in ends)
                    found |= dict(zip(ends, both, strict=True))
        self.loop.set_operate(found)

    def _sp(self) -> None:
        self.loop.set_sp([float(self.rng.uniform(s.low, s.high)) for s in self.loop.manifest.sp])

    def _mode(self) -> None:
        self.loop.set_mode(str(self.rng.choice(["AUTO", "AUTO", "AUTO", "MANUAL", "HOLD", "SHADOW"])))

    def _hand(self) -> None:
        self.loop.set_mv([float(self.rng.uniform(s.low, s.high)) for s in self.loop.manifest.mv])
        self._sent |= self._theirs()

    def _swap(self) -> None:
        if self.loop.successor is not None and self.rng.random() < 0.3:
            self.loop.keep()
            return
        new = self.laws[int(self.rng.integers(len(self.laws)))]
        self.loop.swap(new, int(self.rng.choice([1, 5, 20])))

    def _local(self) -> None:
        """An MV goes local, or comes back; its contact is mostly, but not always, wired to ``use``."""
        i = int(self.rng.integers(len(self.plant.local)))
        self.plant.local[i] = self.plant.reads_back and not self.plant.local[i]
        if self.rng.random() < 0.8:
            self.loop.set_operate({f"u{i}.use": float(not self.plant.local[i])})


# -------------------------------------------------------------------------------------------------------- all histories
def opened(folder: Path, law_by: str = "onnx") -> Callable[[int], Sequence[Watched]]:
    """The laws of a kind, made once; ``law_by`` as of ``stress``."""
    known = dict[int, list[Watched]]()

    def laws(number: int) -> Sequence[Watched]:
        if number not in known:
            known[number] = [Watched(file, law_by) for file in laws_of(number, folder)]
        return known[number]

    return laws


def run(
    first: int, scans: int, folder: Path, *, law_by: str = "onnx", tell: Callable[[str], None] = print
) -> dict[str, dict[str, int]]:
    """Histories from a seed on until so many scans are made; the counts, those of an earlier run in the folder too."""
    file, laws = folder / f"counts_{first}.json", opened(folder, law_by)
    done: dict[str, Any] = {"histories": 0, "wrong": {}, "seen": {}, "faults": {}}
    if file.exists():
        done = json.loads(file.read_text(encoding="utf-8"))
    counts = {name: Counter[str](done[name]) for name in ("wrong", "seen", "faults")}
    begun = time.perf_counter()
    made, wanted = int(done["histories"]), -(-scans // SCANS)
    for k in range(made, wanted):
        found = History(first + k, laws).run()
        for name, counter in counts.items():
            counter.update(getattr(found, name))
        for words in found.first.values():
            tell(f"seed {first + k} ({KINDS[(first + k) % len(KINDS)].name}): {words}")
        if (k + 1) % KEPT == 0 or k + 1 == wanted:
            kept = {"histories": k + 1, **{name: dict(counter) for name, counter in counts.items()}}
            file.write_text(json.dumps(kept), encoding="utf-8")
            took = time.perf_counter() - begun
            tell(f"{(k + 1) * SCANS} scans, {sum(counts['wrong'].values())} wrong, {took:.0f} s here")
    return {name: dict(counter.most_common()) for name, counter in counts.items()}


def main() -> None:
    """Run, and print the counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=1_000_000, help="of all histories (1000000)")
    parser.add_argument("--first", type=int, default=0, help="seed of the first history (0)")
    parser.add_argument("--folder", type=Path, help="where laws and counts are kept")
    parser.add_argument("--law-by", choices=LAW_BY, default=LAW_BY[0], help="what computes the laws, as of `stress`")
    options = parser.parse_args()
    logging.getLogger("loopwright.serving.loop").setLevel(logging.CRITICAL)
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as made:
        folder = options.folder or Path(made)
        folder.mkdir(parents=True, exist_ok=True)
        for name, counts in run(options.first, options.scans, folder, law_by=options.law_by).items():
            print(f"{name}: {', '.join(f'{n} {count}' for n, count in counts.items()) or 'none'}")


if __name__ == "__main__":
    main()
