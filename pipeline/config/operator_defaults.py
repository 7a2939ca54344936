"""Numbers that operators of a predictive law start from, as a person gives them: ranges, ranks, rests, costs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

MOST_RANKS = 4  # ranks of ranges, 1 kept first; the last one is still dearer than an error
MOST_COST = 1e6  # of a cost per unit: only ratios count

OPERATED = ("range_low", "range_high", "rank", "rest", "cost")
"""Names of the numbers, as in the table of tags."""

OPERATED_OF = {"pv": ("range_low", "range_high", "rank", "cost"), "mv": ("rest", "cost")}
"""Signals' roles, and the numbers that each may have."""


def mistakes_of_operated(
    role: str, stated_role: str, given: Mapping[str, float], within: tuple[float, float]
) -> list[str]:
    """Faults in the numbers ``given`` by name of a signal, a clause each.

    ``role`` is pv, mv or another, ``stated_role`` its word in the table. ``within`` are the ends of a PV's readings or
    of an MV's commands, infinite where nobody gave them.
    """
    own, wrong = OPERATED_OF.get(role, ()), list[str]()
    for name, value in given.items():
        if name not in own:
            wrong.append(f"{name} belongs to a {_roles_with(name)}, not to a {stated_role}; leave it empty")
        elif name == "rank" and not 1 <= value <= MOST_RANKS:
            wrong.append(f"rank is {value:g}; give 1 to {MOST_RANKS}, 1 is kept first")
        elif name == "cost" and not abs(value) <= MOST_COST:
            wrong.append(f"cost is {value:g}; give {-MOST_COST:g} to {MOST_COST:g}, for only ratios of costs count")
        elif name not in {"rank", "cost"} and not within[0] <= value <= within[1]:
            what = "may be commanded" if name == "rest" else "a reading can be"
            wrong.append(f"{name} is {value:g}, outside of what {what}, {within[0]:g} to {within[1]:g}")
    low, high = given.get("range_low"), given.get("range_high")
    if low is not None and high is not None and not low < high:
        wrong.append(f"the range is {low:g} to {high:g}; range_low must be below range_high")
    return wrong


def _roles_with(name: str, roles: Sequence[str] = tuple(OPERATED_OF)) -> str:
    return " or ".join(role for role in roles if name in OPERATED_OF[role])
