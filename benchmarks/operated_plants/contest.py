"""The three controllers of a plant over the same days, and a row of their figures."""

from __future__ import annotations

import hashlib
import inspect
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import figures as figures_module
import numpy as np
import perfect_economic
from figures import DayController, Figures, Run, figures_of, run_day
from from_record import FOLDER, Fit, Served, controller_of, law_of
from operated_plant import DAY, OperatedPlant
from perfect_economic import PerfectEconomic
from pid_blocks import searched

from loopwright.pipeline.files import write_bytes
from loopwright.pipeline.plants.simulator import Array

SCORED = (101, 102, 103)  # seeds of the days that count
TUNING = (901, 902)  # of those on which the PIDs are tuned
TUNING_DAY = 360  # samples
# Of the tuning's cost, beside an error of 1 % of a set point's range: 1 % of a range beyond it in the mean, 1 % of
# travel a sample, 1 % of the largest cost's span, and 1 % off a resting value.
BEYOND, TRAVEL, COST, REST = 10.0, 0.5, 1.0, 0.1


@dataclass(frozen=True, slots=True)
class Contest:
    """Figures of one plant, by controller, and the runs of its first day."""

    plant: OperatedPlant
    figures: dict[str, Figures]
    first: dict[str, Run]
    settings: dict[str, float]
    seconds: dict[str, float]


def tuned_settings(plant: OperatedPlant, samples: int = TUNING_DAY, days: Sequence[int] = TUNING) -> Array:
    """The numbers of the plant's PIDs, tuned on days that are not scored; kept in a file."""
    known = [
        plant.name,
        plant.title,
        BEYOND,
        TRAVEL,
        COST,
        REST,
        samples,
        list(days),
        dict(plant.settings),
        dict(plant.operate),
        _digest(plant),
    ]
    path = FOLDER / f"{plant.name}-pid-{hashlib.sha256(json.dumps(known).encode()).hexdigest()[:12]}.json"
    if path.exists():
        return np.array(json.loads(path.read_text()))
    courses = [plant.day(seed, samples) for seed in days]
    of_pv, of_mv = plant.costs
    reach = np.array([s.high - s.low for s in plant.mv])
    largest = max(np.abs(of_mv * reach).max(initial=0.0), np.abs(of_pv * _widths(plant)).max(initial=0.0), 1e-12)

    def cost(numbers: Array) -> float:
        try:
            runs = [run_day(plant, plant.scheme(plant, numbers), day) for day in courses]
        except (RuntimeError, FloatingPointError, ZeroDivisionError):
            return np.inf
        f = figures_of(plant, courses, runs)
        spent = -f.profit / 20 / largest * 100
        found = (
            np.nan_to_num(f.error) + BEYOND * f.beyond + TRAVEL * f.travel + COST * spent + REST * np.nan_to_num(f.rest)
        )
        return float(found) if np.isfinite(found) else np.inf

    best = searched(np.array(list(plant.settings.values())), cost)
    write_bytes(path, json.dumps(best.tolist()).encode())
    return best


def contested(
    plant: OperatedPlant,
    *,
    fit: Fit,
    seeds: Sequence[int] = SCORED,
    samples: int = DAY,
    say: Callable[[str], None] = print,
) -> Contest:
    """All three controllers over the days of ``seeds``."""
    seconds = {}
    model, seconds["fit"] = fit.model(plant)
    began = time.process_time()
    law = law_of(plant, model)
    controller = controller_of(plant, law)
    seconds["design"] = time.process_time() - began
    began = time.process_time()
    settings = tuned_settings(plant)
    seconds["tuning"] = time.process_time() - began
    # Numbers that are given, so that a search of ours does not move the bound.
    perfect = PerfectEconomic(plant, law_of(plant, model, tuning="given"), model)
    days = [plant.day(seed, samples) for seed in seeds]
    ways: dict[str, Callable[[], DayController]] = {
        "ours": lambda: Served(controller),
        "PID": lambda: plant.scheme(plant, settings),
        "NMPC": lambda: (perfect.reset(), perfect)[1],
    }
    figures, first = {}, {}
    for name, way in ways.items():
        began = time.process_time()
        runs = [run_day(plant, way(), day) for day in days]
        seconds[name] = time.process_time() - began
        figures[name], first[name] = figures_of(plant, days, runs), runs[0]
    if perfect.failures:
        say(f"  {plant.name}: IPOPT found no plan at {perfect.failures} samples; the last plan went on")
    return Contest(plant, figures, first, dict(zip(plant.settings, settings, strict=True)), seconds)


def bound_of(plant: OperatedPlant, fit: Fit, seeds: Sequence[int], samples: int) -> Figures:
    """The NMPC's figures alone, kept in a file; the record and the law's numbers give its scales alone."""
    code = [inspect.getsource(module) for module in (perfect_economic, figures_module)]
    known = [plant.name, dict(plant.operate), _digest(plant), fit.rows, list(seeds), samples, *code]
    path = FOLDER / f"{plant.name}-nmpc-{hashlib.sha256(json.dumps(known).encode()).hexdigest()[:12]}.json"
    if not path.exists():
        model, _ = fit.model(plant)
        perfect = PerfectEconomic(plant, law_of(plant, model, tuning="given"), model)
        days = [plant.day(seed, samples) for seed in seeds]
        runs = [run_day(plant, (perfect.reset(), perfect)[1], day) for day in days]
        write_bytes(path, json.dumps(asdict(figures_of(plant, days, runs))).encode())
    return Figures(**json.loads(path.read_text()))


HEAD = (
    f"{'plant':12} {'':5} {'error [%]':>9} {'/NMPC':>6} {'in range [%]':>12} {'beyond [%]':>10}"
    f" {'profit/h':>9} {'of NMPC':>8} {'travel':>7} {'rest':>5} {'[s]':>6}"
)


def rows_of(contest: Contest) -> str:
    """Three rows of a table."""
    bound = contest.figures["NMPC"]
    lines = []
    for name, f in contest.figures.items():
        ratio = f.error / bound.error if np.isfinite(f.error) else np.nan
        share = share_of(f.profit, bound.profit)
        lines.append(
            f"{contest.plant.name if name == 'ours' else '':12} {name:5} {f.error:9.3f} {ratio:6.2f} {f.inside:12.1f}"
            f" {f.beyond:10.4f} {f.profit:9.2f} {share:>8} {f.travel:7.2f} {f.rest:5.1f} {contest.seconds[name]:6.0f}"
        )
    return "\n".join(lines)


def share_of(profit: float, bound: float) -> str:
    """Profit over the NMPC's [%]; of costs, 100 % less what is spent beyond the NMPC's. "-" where there are none."""
    return "-" if bound == 0 else f"{100 + 100 * (profit - bound) / abs(bound):.1f}"


def as_json(contest: Contest) -> str:
    """The figures, settings and seconds."""
    found = {
        "plant": contest.plant.name,
        "figures": {name: asdict(f) for name, f in contest.figures.items()},
        "settings": contest.settings,
        "seconds": contest.seconds,
    }
    return json.dumps(found)


def _widths(plant: OperatedPlant) -> Array:
    return np.array([np.diff(plant.range_of(i))[0] for i in range(len(plant.pv))])


def _digest(plant: OperatedPlant) -> list[list[float]]:
    """A few samples of the plant under its schemes: another equation or scheme is tuned anew."""
    day = plant.day(1, 12)
    run = run_day(plant, plant.scheme(plant, np.array(list(plant.settings.values()))), day)
    return [*run.pv[::4].round(6).tolist(), *run.mv[::4].round(6).tolist()]
