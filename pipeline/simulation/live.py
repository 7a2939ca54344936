"""A plant behind the loop's endpoint, and the loop on a terminal while it runs."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import IO

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.plants.simulator import Array, Simulator
from loopwright.pipeline.simulation.timetable import Timetable
from loopwright.serving.guard import Sample
from loopwright.serving.manifest import Signal

WINDOW_S = 60.0  # [s] of the course that is shown
COURSE_WIDTH = 60  # letters of a course
BARS = "▁▂▃▄▅▆▇█"
Show = Callable[[float, str, Array, str, str | None], None]
"""``show(time_s, mode, values, reason, mark)`` shows one scan: set points, PVs and MVs in ``values``, what was wrong
in ``reason`` (empty if nothing), what happens in ``mark``."""


class SimulatedPlant:
    """The plant as an endpoint: each write advances it by one period, each read measures it."""

    def __init__(self, plant: Simulator, run: Timetable) -> None:
        self.plant, self.run = plant, run
        self._step, self._parameters = plant.stepper(), plant.parameters()
        self._places = {plant.parameter_names().index(name): values for name, values in run.changes.items()}
        self.k = 0
        self._dv = run.dv
        self.x, self.mv = run.x0.copy(), run.mv0.copy()

    @property
    def pv(self) -> Array:
        """True process variables, shape (n_pv,)."""
        return self.plant.measure(self.x)

    @property
    def dv(self) -> Array:
        """Measured disturbances, shape (n_dv,)."""
        return self.plant.dv_nominal if self._dv is None else self._dv[min(self.k, len(self._dv) - 1)]

    def read(self) -> Sample:
        """Process variables and measured disturbances with their noise, and the MV that was applied."""
        run, k = self.run, self.k
        return Sample(pv=self.pv + run.noise[k], mv_applied=self.mv, dv=self.dv + run.dv_noise[k])

    def write(self, mv: Array) -> None:
        """Hold ``mv`` for one period."""
        for place, values in self._places.items():
            self._parameters[place] = values[self.k]
        self.mv = mv
        self.x = self._step(self.x, mv, self.dv, self._parameters)
        self.k += 1
        if not np.isfinite(self.x).all():
            raise PlantError(
                f"plant {self.plant.name!r} has left what it can compute at {self.k * self.plant.period_s:g} s; "
                "give disturbances that it can physically meet"
            )


@contextmanager
def view_of(plant: Simulator, title: str, duration_s: float, stream: IO[str]) -> Iterator[Show]:
    """A live view on a terminal, plain lines anywhere else."""
    if not stream.isatty():
        yield PlainView(plant, duration_s, stream).show
        return
    with Live(console=Console(file=stream), auto_refresh=False) as live:
        yield TerminalView(plant, title, duration_s, live).show


class PlainView:
    """A line where something happens, and twenty others on the way."""

    def __init__(self, plant: Simulator, duration_s: float, stream: IO[str]) -> None:
        self.signals, self.stream = _labelled(plant), stream
        self.every_s, self.next_s = duration_s / 20, 0.0
        self.last: tuple[str, str, tuple[float, ...]] | None = None
        self.n_sp = len(plant.sp_signals)

    def show(self, time_s: float, mode: str, values: Array, reason: str, mark: str | None) -> None:
        """Print the scan if it is one of those worth a line."""
        now = (mode, reason, tuple(values[: self.n_sp]))
        if now == self.last and mark is None and time_s < self.next_s:
            return
        self.last, self.next_s = now, time_s + self.every_s
        figures = [
            f"{label} {value:.5g}" + ("" if s.unit == "-" else f" {s.unit}")
            for (label, s), value in zip(self.signals, values, strict=True)
        ]
        notes = "  ".join(note for note in (mark, reason) if note)
        print(f"{time_s:9.1f} s  {mode:<6}  {'  '.join(figures)}  {notes}".rstrip(), file=self.stream)


class TerminalView:
    """Mode, values and the last minute of each signal, redrawn ten times a second."""

    def __init__(self, plant: Simulator, title: str, duration_s: float, live: Live) -> None:
        self.signals, self.title, self.duration_s, self.live = _labelled(plant), title, duration_s, live
        self.last_s = duration_s - plant.period_s - 1e-9
        self.recent: deque[Array] = deque(maxlen=max(2, round(WINDOW_S / plant.period_s)))
        self.events: deque[str] = deque(maxlen=4)
        self.reason = ""
        self.drawn_s = -np.inf

    def show(self, time_s: float, mode: str, values: Array, reason: str, mark: str | None) -> None:
        """Keep the scan; draw at most ten times a second of the viewer's time."""
        self.recent.append(values)
        if mark:
            self.events.append(f"{time_s:.1f} s  {mark}")
        if reason and reason != self.reason:
            self.events.append(f"{time_s:.1f} s  fault: {reason}")
        self.reason = reason
        now = self.live.console.get_time()
        if now - self.drawn_s >= 0.1 or time_s >= self.last_s:
            self.drawn_s = now
            self.live.update(self._picture(time_s, mode), refresh=True)

    def _picture(self, time_s: float, mode: str) -> Group:
        style = {"AUTO": "bold green", "MANUAL": "bold yellow", "HOLD": "bold red"}[mode]
        head = Text.assemble(
            (f"{self.title}  ", "bold"), (f" {mode} ", style), f"  {time_s:.1f} of {self.duration_s:.1f} s"
        )
        table = Table(box=None, pad_edge=False)
        for column in ("", "now", "", f"last {WINDOW_S:g} s"):
            table.add_column(column, justify="right" if column == "now" else "left", no_wrap=True)
        rows = np.array(self.recent)
        for i, (label, s) in enumerate(self.signals):
            table.add_row(label, f"{rows[-1, i]:.5g}", s.unit, sparkline(rows[:, i], s.low, s.high))
        return Group(head, table, *(Text(event, style="dim") for event in self.events))


def sparkline(values: Array, low: float, high: float, width: int = COURSE_WIDTH) -> str:
    """The values as bars over [low, high], the newest at the right end; the mean where several share a bar."""
    groups = np.array_split(values, min(width, len(values)))
    share = (np.array([group.mean() for group in groups]) - low) / (high - low)
    places = np.clip(np.nan_to_num(share) * len(BARS), 0, len(BARS) - 1).astype(int)
    return "".join(BARS[i] for i in places)


def _labelled(plant: Simulator) -> list[tuple[str, Signal]]:
    """Label and signal of each of a scan's values."""
    return [
        *((f"SP {s.name}", s) for s in plant.sp_signals),
        *((s.name, s) for s in (*plant.pv_signals, *plant.mv_signals)),
    ]
