"""Requests of the plant's own operator by the nodes of its set points and its mode."""

from __future__ import annotations

from collections.abc import Mapping

from loopwright.serving.opcua.sampling import Values

MODE = "mode"


class Wishes:
    """A value that has changed is a wish.

    The set points that stand there when the loop begins are wishes, too; the mode is none. The values of a server that
    has started anew are its defaults: nobody asked for them, and they are no wish until they change.
    """

    def __init__(self) -> None:
        self._stands: dict[str, float | str] = {}  # since the loop began, or the server did
        self.starts = 0  # of the server, as far as its values were looked at
        self._unheard: Mapping[str, str] = {}

    def of(self, values: Values) -> tuple[dict[str, float], str]:
        """Set points by name, and the mode, that are asked for with these values; empty where there is no wish."""
        if values.starts != self.starts:
            self.starts = values.starts
            self._stands.clear()
        points = {n: v for n, v in values.asked_sp.items() if self._changed(f"SP {n}", v, first=self.starts == 0)}
        mode = values.asked_mode
        return points, mode if mode and self._changed(MODE, mode, first=False) else ""

    def refused(self, values: Values) -> list[str]:
        """Why a set point or the mode is no wish, in a line for each; each is told once while it lasts."""
        before, self._unheard = self._unheard, values.unheard
        return [why for name, why in values.unheard.items() if name not in before]

    def _changed(self, name: str, value: float | str, *, first: bool) -> bool:
        """Whether a value is a wish; ``first``: also one that is seen for the first time."""
        before = self._stands.get(name)
        self._stands[name] = value
        return first if before is None else before != value
