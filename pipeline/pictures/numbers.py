"""How numbers are written in front of a person."""

from __future__ import annotations


def number(value: float, digits: int = 3) -> str:
    """``value`` with so many digits, thousands grouped and not as a power of ten."""
    large = 10 ** min(digits, 4) <= abs(value) < 1e9
    return f"{value:,.0f}" if large else f"{value:.{digits}g}"


def ratio(value: float | None) -> str:
    """A multiple of a bound: two decimals, and more within a hundredth of it; a dash where there is none."""
    return "–" if value is None else f"{value:.3f}" if abs(value - 1) < 0.01 else f"{value:.2f}"


def figure(value: float | None, digits: int = 3) -> str:
    """A number with so many digits; a dash where nothing was measured."""
    return "–" if value is None else number(value, digits)


def times(value: float | None) -> str:
    """A ratio with three digits, and one more where it comes near 1."""
    return "–" if value is None else number(value, 4 if abs(value - 1) < 0.01 else 3)


def kilobytes(value: int | None) -> str:
    """The size of a file."""
    return "–" if value is None else f"{value / 1024:.0f} kB"
