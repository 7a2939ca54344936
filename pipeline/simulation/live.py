"""A plant behind the loop's endpoint, and the loop on a terminal while it runs."""

from __future__ import annotations

from collections import deque
from typing import IO, Protocol

import numpy as np
from numpy.typing import NDArray
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from pipeline.errors import PlantError
from pipeline.plants.simulator import Simulator
from pipeline.simulation.timetable import Timetable
from serving.guard import Sample

Array = NDArray[np.float64]
WINDOW_S = 60.0
WIDTH = 60
BARS = "▁▂▃▄▅▆▇█"


class SimulatedPlant:
    """The plant as an endpoint: each write advances it by one period, each read measures it."""

    def __init__(self, plant: Simulator, run: Timetable) -> None:
        self.plant, self.run = plant, run
        self._step = plant.stepper()
        self._parameters = plant.parameters()
        self._places = {plant.parameter_names().index(name): values for name, values in run.changes.items()}
        self.k = 0
        self.x, self.mv = run.x0.copy(), run.mv0.copy()

    @property
    def pv(self) -> Array:
        """True process variables, shape (n_pv,)."""
        return self.plant.measure(self.x)

    def read(self) -> Sample:
        """Process variables with their noise, and the MV that was applied."""
        return Sample(pv=self.pv + self.run.noise[self.k], mv_applied=self.mv, dv=self.plant.dv_nominal)

    def write(self, mv: Array) -> None:
        """Hold ``mv`` for one period."""
        for place, values in self._places.items():
            self._parameters[place] = values[self.k]
        self.mv = mv
        self.x = self._step(self.x, mv, self.plant.dv_nominal, self._parameters)
        self.k += 1
        if not np.isfinite(self.x).all():
            at_s = self.k * self.plant.period_s
            raise PlantError(
                f"plant {self.plant.name!r} has left what it can compute at {at_s:g} s; "
                "give disturbances that it can physically meet"
            )


class Snapshot(Protocol):
    """What a view shows of one scan (serving's Command fits)."""

    @property
    def mode(self) -> str:
        """MANUAL, AUTO or HOLD."""

    @property
    def sp(self) -> Array:
        """Set points, shape (n_sp,)."""

    @property
    def mv(self) -> Array:
        """MV, shape (n_mv,)."""

    @property
    def reason(self) -> str:
        """What was wrong; empty if nothing."""


class View(Protocol):
    """Where a running loop is shown."""

    def __enter__(self) -> View:
        """Start showing."""

    def __exit__(self, *_: object) -> None:
        """Leave the terminal as it was."""

    def show(self, time_s: float, pv: Array, command: Snapshot, mark: str | None) -> None:
        """Show one scan; ``mark`` says what happens in it."""


def view_of(plant: Simulator, title: str, duration_s: float, stream: IO[str]) -> View:
    """A live view on a terminal, plain lines anywhere else."""
    if stream.isatty():
        return TerminalView(plant, title, duration_s, Console(file=stream))
    return PlainView(plant, duration_s, stream)


class PlainView:
    """A line where something happens, and twenty others on the way."""

    def __init__(self, plant: Simulator, duration_s: float, stream: IO[str]) -> None:
        self.plant, self.stream = plant, stream
        self.every_s, self.next_s = duration_s / 20, 0.0
        self.last: tuple[str, str, tuple[float, ...]] | None = None

    def __enter__(self) -> PlainView:
        """Nothing to start."""
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing to leave."""

    def show(self, time_s: float, pv: Array, command: Snapshot, mark: str | None) -> None:
        """Print the scan if it is one of those worth a line."""
        now = (command.mode, command.reason, tuple(command.sp))
        if now == self.last and mark is None and time_s < self.next_s:
            return
        self.last, self.next_s = now, time_s + self.every_s
        notes = "  ".join(note for note in (mark, command.reason) if note)
        print(
            f"{time_s:9.1f} s  {command.mode:<6}  {_values(self.plant, pv, command)}  {notes}".rstrip(),
            file=self.stream,
        )


class TerminalView:
    """Mode, values and the last minute of each signal, redrawn ten times a second."""

    def __init__(self, plant: Simulator, title: str, duration_s: float, console: Console) -> None:
        self.plant, self.title, self.duration_s = plant, title, duration_s
        self.recent: deque[Array] = deque(maxlen=max(2, round(WINDOW_S / plant.period_s)))
        self.events: deque[str] = deque(maxlen=4)
        self.reason = ""
        self.live = Live(console=console, refresh_per_second=10, auto_refresh=False)
        self.drawn_s = -np.inf

    def __enter__(self) -> TerminalView:
        """Take the terminal."""
        self.live.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        """Draw the end and give the terminal back."""
        self.live.refresh()
        self.live.__exit__(None, None, None)

    def show(self, time_s: float, pv: Array, command: Snapshot, mark: str | None) -> None:
        """Keep the scan; draw at most ten times a second of the viewer's time."""
        self.recent.append(np.concatenate([command.sp, pv, command.mv]))
        if mark:
            self.events.append(f"{time_s:.1f} s  {mark}")
        if command.reason and command.reason != self.reason:
            self.events.append(f"{time_s:.1f} s  fault: {command.reason}")
        self.reason = command.reason
        now = self.live.console.get_time()
        if now - self.drawn_s >= 0.1 or time_s + self.plant.period_s >= self.duration_s - 1e-9:
            self.drawn_s = now
            self.live.update(self._picture(time_s, command), refresh=True)

    def _picture(self, time_s: float, command: Snapshot) -> Group:
        style = {"AUTO": "bold green", "MANUAL": "bold yellow", "HOLD": "bold red"}[str(command.mode)]
        head = Text.assemble(
            (f"{self.title}  ", "bold"), (f" {command.mode} ", style), f"  {time_s:.1f} of {self.duration_s:.1f} s"
        )
        table = Table(box=None, pad_edge=False)
        for column in ("", "now", "", f"last {WINDOW_S:g} s"):
            table.add_column(column, justify="right" if column == "now" else "left", no_wrap=True)
        rows = np.array(self.recent)
        p = self.plant
        labels = [f"SP {s.name}" for s in p.sp_signals] + [s.name for s in (*p.pv_signals, *p.mv_signals)]
        for i, (label, s) in enumerate(zip(labels, (*p.sp_signals, *p.pv_signals, *p.mv_signals), strict=True)):
            table.add_row(label, f"{rows[-1, i]:.5g}", s.unit, sparkline(rows[:, i], s.low, s.high))
        return Group(head, table, *(Text(event, style="dim") for event in self.events))


def sparkline(values: Array, low: float, high: float, width: int = WIDTH) -> str:
    """The values as bars over [low, high], the newest at the right end; the mean where several share a bar."""
    groups = np.array_split(values, min(width, len(values)))
    share = (np.array([group.mean() for group in groups]) - low) / (high - low)
    places = np.clip(np.nan_to_num(share) * len(BARS), 0, len(BARS) - 1).astype(int)
    return "".join(BARS[i] for i in places)


def _values(plant: Simulator, pv: Array, command: Snapshot) -> str:
    parts = [f"SP {s.name} {v:.4g}" for s, v in zip(plant.sp_signals, command.sp, strict=True)]
    parts += [
        f"{s.name} {v:.5g}" + ("" if s.unit == "-" else f" {s.unit}")
        for s, v in zip((*plant.pv_signals, *plant.mv_signals), (*pv, *command.mv), strict=True)
    ]
    return "  ".join(parts)
