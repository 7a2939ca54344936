"""Records like the public ones, made from equations: what is true of them is known, and so is their noise.

Of each plant: rows to learn, rows to test with other moves, and the outputs without noise. All numbers were chosen from
what the benchmarks' pages say of plant and noise, before any model was fitted. The same seed gives the same rows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from _free_run import Array, Part, Task
from scipy.signal import cont2discrete

State = tuple[float, ...]


def integrated(slope: Callable[[State, float], State], x: State, u: Array, fine: int, period_s: float) -> Array:
    """The first state (n,) at each row, by Runge and Kutta's fourth-order steps, ``fine`` of them a row.

    u ((n + 1) fine,) is the input at the steps, straight between two of them.
    """
    dt, found = period_s / fine, np.empty(len(u) // fine - 1)
    v = u.tolist()
    for k in range(len(found)):
        found[k] = x[0]
        for i in range(k * fine, (k + 1) * fine):
            middle = (v[i] + v[i + 1]) / 2
            s1 = slope(x, v[i])
            s2 = slope(tuple(a + dt / 2 * b for a, b in zip(x, s1, strict=True)), middle)
            s3 = slope(tuple(a + dt / 2 * b for a, b in zip(x, s2, strict=True)), middle)
            s4 = slope(tuple(a + dt * b for a, b in zip(x, s3, strict=True)), v[i + 1])
            x = tuple(a + dt / 6 * (b + 2 * c + 2 * d + e) for a, b, c, d, e in zip(x, s1, s2, s3, s4, strict=True))
    return found


def multisine(rng: np.random.Generator, rows: int, period_s: float, band_hz: tuple[float, float], fine: int) -> Array:
    """One period (rows * fine,) of all lines of a band with random phases, root mean square 1."""
    line_hz = 1 / (rows * period_s)
    lines = np.arange(max(1, int(np.ceil(band_hz[0] / line_hz))), int(band_hz[1] / line_hz) + 1)
    spectrum = np.zeros(rows * fine // 2 + 1, dtype=np.complex128)
    spectrum[lines] = np.exp(2j * np.pi * rng.uniform(size=len(lines)))
    signal = np.fft.irfft(spectrum, rows * fine)
    return np.asarray(signal / np.sqrt(np.mean(signal**2)))


def noisy(u: Array, true: Array, noise: float, rng: np.random.Generator) -> Part:
    """Rows as measured: white noise of this standard deviation on the output."""
    return Part(u, true + noise * rng.standard_normal(len(true)), true)


# ---------------------------------------------------------------------- a Duffing oscillator, like the Silverbox
def duffing(seed: int = 0, rows: int = 20_000) -> Task:
    """An oscillator with a hardening spring [V], 610 Hz; a multisine to learn, another and an arrow to test.

        y'' + 2 d w y' + w^2 (y + 4 y^3) = w^2 u,    w = 2 pi 68/s,  d = .05;    noise .2 mV

    The arrow is a multisine that grows from nothing to 1.5 times the size that was learnt.
    """
    w, damping, fine, period_s = 2 * np.pi * 68.0, 0.05, 8, 1 / 610.35
    rng = np.random.default_rng(seed)

    def slope(x: State, u: float) -> State:
        return x[1], w * w * (u - x[0] - 4 * x[0] ** 3) - 2 * damping * w * x[1]

    def part(n: int, size: Array | float) -> Part:
        u = 0.02 * size * multisine(rng, n + 1, period_s, (1.0, 200.0), fine)
        return noisy(u[: n * fine : fine], integrated(slope, (0.0, 0.0), u, fine, period_s), 2e-4, rng)

    n = 4 * rows // 5
    parts = [part(rows, 1.0), part(2 * rows // 5, 1.0), part(n, np.linspace(0, 1.5, (n + 1) * fine))]
    return Task(parts[0], {"multisine": parts[1], "arrow": parts[2]}, 50, period_s, scale=1e3)


# ---------------------------------------------------------------------- two tanks that overflow
def two_tanks(seed: int = 0, rows: int = 1024) -> Task:
    """A pump [V] fills a tank that drains into a second one, whose level is measured [V], 4 s; noise .02 V.

        x1' = .067 u - .1 sqrt(x1) - s,    x2' = .1 sqrt(x1) + s / 2 - .085 sqrt(x2)

    Levels end at 10.1 V, the transmitter at 10 V. What tank 1 spills (s), falls into tank 2 by half; what that one
    spills is lost.
    """
    period_s, fine = 4.0, 40
    rng = np.random.default_rng(seed)

    def levels(u: Array) -> Array:
        dt, x1, x2, found = period_s / fine, 5.0, 5.0, np.empty(len(u))
        for k, pump in enumerate(u.tolist()):
            found[k] = x2
            for _ in range(fine):
                through, out = 0.1 * x1**0.5, 0.085 * x2**0.5
                x1 += dt * (0.067 * pump - through)
                spilt = max(x1 - 10.1, 0.0)
                x1 -= spilt
                x2 = min(x2 + dt * (through - out) + spilt / 2, 10.1)
        return np.minimum(found, 10.0)

    def part() -> Part:
        u = multisine(rng, rows, period_s, (0.0, 0.0144), 1)
        u = np.clip(3.2 + 1.4 * u, 0.4, 6.5)
        true = levels(u)
        return Part(u, np.minimum(true + 0.02 * rng.standard_normal(rows), 10.0), true)

    return Task(part(), {"test": part()}, 5, period_s, overflows=True)


# ---------------------------------------------------------------------- a drive whose sensor knows no sign
def drive(seed: int = 0, rows: int = 500) -> Task:
    """A motor turns a pulley through an elastic belt, 20 ms; a pulse counter reads |speed|, noise .02.

        speed = 1 / (.25 s + 1)  w^2 / (s^2 + 2 d w s + w^2)  u,    w = 2 pi 1.5/s,  d = .12;    y = |speed|

    The voltage is uniform in -.8 to 1.2, held for 10 rows. The first four fifths of the rows are to learn.
    """
    period_s, w, damping = 0.02, 2 * np.pi * 1.5, 0.12
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-0.8, 1.2, -(-rows // 10)), 10)[:rows]
    denominator: Array = np.asarray(np.polymul([0.25, 1.0], [1.0, 2 * damping * w, w * w]), dtype=np.float64)
    a, b, _, _ = (np.atleast_2d(m) for m in _companion(denominator, w * w, period_s))
    x, speed = np.zeros(3), np.empty(rows)
    for k in range(rows):
        speed[k] = x[0]
        x = a @ x + b[:, 0] * u[k]
    whole, cut = noisy(u, np.abs(speed), 0.02, rng), 4 * rows // 5
    learn, test = (Part(whole.u[r], whole.y[r], np.abs(speed)[r]) for r in (slice(0, cut), slice(cut, None)))
    return Task(learn, {"test": test}, 4, period_s)


def _companion(denominator: Array, gain: float, period_s: float) -> tuple[Array, ...]:
    """Sampled matrices of gain / denominator(s), the output first among the states, the input held over a row."""
    n = len(denominator) - 1
    a = np.eye(n, k=1)
    a[-1] = -denominator[:0:-1] / denominator[0]
    b = np.zeros((n, 1))
    b[-1] = gain / denominator[0]
    return cont2discrete((a, b, np.eye(1, n), np.zeros((1, 1))), period_s)[:4]


# ---------------------------------------------------------------------- friction, like EMPS
def friction(seed: int = 0, rows: int = 2485) -> Task:
    """A sledge with friction, its position [m] held by a controller: force [N] to position, 10 ms, noise .02 mm.

        95.1 q'' = u - 203.5 q' - 20.4 sign(q') + 3.2

    The controller follows way points. In the test, pulses of up to 60 N come on top of its force, and u holds them.
    """
    period_s, fine, mass = 0.01, 100, 95.1
    rng = np.random.default_rng(seed)

    def part(pulses: float) -> Part:
        goal = _way(rng, rows, period_s)
        extra = np.repeat(pulses * rng.uniform(-1, 1, rows // 15 + 1) * (rng.uniform(size=rows // 15 + 1) < 0.3), 15)
        noise = 2e-5 * rng.standard_normal(rows)
        q, v, before, dt = 0.0, 0.0, 0.0, period_s / fine
        true, u = np.empty(rows), np.empty(rows)
        for k in range(rows):
            true[k], seen = q, q + noise[k]
            speed, before = (seen - before) / period_s, seen
            u[k] = np.clip(15 * mass * (6.0 * (goal[k] - seen) - speed) + extra[k], -150, 150)
            for _ in range(fine):
                v += dt / mass * (u[k] - 203.5 * v + 3.2)
                v -= np.sign(v) * min(abs(v), dt / mass * 20.4)  # it sticks where friction can stop it within a step
                q += dt * v
        return Part(u, true + noise, true)

    return Task(part(0.0), {"test": part(60.0)}, 20, period_s, scale=1e3)


def _way(rng: np.random.Generator, rows: int, period_s: float) -> Array:
    """Positions (rows,) [m] between 0 and .25: straight to the next point at .05 to .2 m/s, then a short rest."""
    way = [0.0]
    while len(way) < rows:
        end = rng.uniform(0, 0.25)
        steps = max(2, int(abs(end - way[-1]) / rng.uniform(0.05, 0.2) / period_s))
        way += [*np.linspace(way[-1], end, steps).tolist(), *[end] * int(rng.integers(10, 60))]
    return np.array(way[:rows])


# ---------------------------------------------------------------------- hysteresis: the benchmark's own equations
BOUC_WEN_PERIOD_S, BOUC_WEN_BEGIN, _FINE = 1 / 750, 50, 20


def bouc_wen(seed: int = 0, rows: int = 8192) -> Task:
    """A mass on a spring with hysteresis: force [N] to position [m], 750 Hz; noise 8 um in the rows to learn alone.

        2 y'' + 10 y' + 5e4 y + z = u,    z' = 5e4 y' - 1e3 (.8 |y'| z - 1.1 y' |z|)

    To learn: two multisines of 50 N, 5 to 150 Hz, one after the other. Tests: another one that has settled, and a sweep
    from 20 to 50 Hz of 40 N, nine times as fast as the benchmark's.

    Source: J. P. Noel, M. Schoukens, Hysteretic benchmark with a dynamic nonlinearity, Workshop on Nonlinear System
    Identification Benchmarks, Brussels 2016.
    """
    rng = np.random.default_rng(seed)
    learn = bouc_wen_learn(rng, rows)
    period = 50 * multisine(rng, rows, BOUC_WEN_PERIOD_S, (5.0, 150.0), _FINE)
    settled = _hysteresis(np.concatenate([period, period, period[:_FINE]]))[rows:]
    t = BOUC_WEN_PERIOD_S / _FINE * np.arange(2 * rows * _FINE)
    sweep = 40 * np.sin(2 * np.pi * (20 * t + (50 - 20) / (2 * t[-1]) * t**2))
    run = _hysteresis(sweep)
    u = period[::_FINE]
    tests = {"multisine": Part(u, settled, settled), "sweep": Part(sweep[: len(run) * _FINE : _FINE], run, run)}
    return Task(learn, tests, BOUC_WEN_BEGIN, BOUC_WEN_PERIOD_S, scale=1e6)


def bouc_wen_learn(rng: np.random.Generator, rows: int = 8192) -> Part:
    """The rows to learn: two multisines of ``rows`` each from rest, with noise."""
    u = 50 * np.concatenate([multisine(rng, rows, BOUC_WEN_PERIOD_S, (5.0, 150.0), _FINE) for _ in range(2)])
    return noisy(u[:-_FINE:_FINE], _hysteresis(u), 8e-6, rng)


def _hysteresis(u: Array) -> Array:
    def slope(x: State, force: float) -> State:
        y, v, z = x
        return v, (force - 10 * v - 5e4 * y - z) / 2, 5e4 * v - 1e3 * (0.8 * abs(v) * z - 1.1 * v * abs(z))

    return integrated(slope, (0.0, 0.0, 0.0), u, _FINE, BOUC_WEN_PERIOD_S)


MADE: Mapping[str, tuple[Callable[..., Task], str, str]] = {
    "made_tanks": (two_tanks, "V", "tanks"),
    "made_drive": (drive, "ticks/s", "drives"),
    "made_friction": (friction, "mm", "EMPS"),
    "made_duffing": (duffing, "mV", "Silverbox"),
    "made_bouc_wen": (bouc_wen, "um", "Bouc-Wen"),
}
"""Name -> what makes it of a seed, the unit of its figures, and the public record that it is like."""
