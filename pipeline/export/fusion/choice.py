"""The form of each value: the cheapest of some uniform preferences, then one by one while that pays."""

from __future__ import annotations

from loopwright.pipeline.export.fusion.plan import Account, Choice, Item

PREFERENCES = (
    ("recipe", "selection", "elementwise", "segments", "increment", "row", "group"),
    ("selection", "elementwise", "gather", "squares", "increment", "recipe", "segments", "row", "group"),
    ("selection", "row", "group", "gather", "squares", "recipe", "segments", "increment", "elementwise"),
    ("selection", "squares", "recipe", "elementwise", "increment", "segments", "row", "group", "gather"),
    ("selection", "elementwise", "squares", "segments", "increment", "row", "group", "gather", "recipe"),
)
SWEEPS = 4
LEAST_GAIN = 0.01  # ns


def choose(choices: list[Choice], roots: list[Item]) -> float:
    """Choose a form for each value; the price of all [ns]."""
    found = []
    for kinds in dict.fromkeys(_preferred(preference, choices) for preference in PREFERENCES):
        account = _with(kinds, choices, roots)
        _sweep(account, choices)
        found.append((account.total, [c.kind for c in choices]))
        _without(account, roots)
    account = Account()
    for choice, kind in zip(choices, min(found)[1], strict=True):
        account.choose(choice, kind)
    for root in roots:
        account.need(root)
    return account.total


def _sweep(account: Account, choices: list[Choice]) -> None:
    """One value after the other, latest first, again while that pays."""
    latest_first = sorted((c for c in choices if len(c.forms) > 1), key=lambda c: c.order, reverse=True)
    for _ in range(SWEEPS):
        before = account.total
        for choice in latest_first:
            if choice.count:
                _improve(account, choice)
        if account.total > before - LEAST_GAIN:
            break


def _improve(account: Account, choice: Choice) -> None:
    """The cheapest form of one choice, the others as they are."""
    best, least = choice.kind, account.total
    for kind in choice.forms:
        if kind != best:
            account.choose(choice, kind)
            if account.total < least - LEAST_GAIN:
                best, least = kind, account.total
    if choice.kind != best:
        account.choose(choice, best)


def _preferred(preference: tuple[str, ...], choices: list[Choice]) -> tuple[str, ...]:
    """The kind of form of each choice that comes first."""
    return tuple(next((k for k in preference if k in c.forms), next(iter(c.forms))) for c in choices)


def _with(kinds: tuple[str, ...], choices: list[Choice], roots: list[Item]) -> Account:
    account = Account()
    for choice, kind in zip(choices, kinds, strict=True):
        account.choose(choice, kind)
    for root in roots:
        account.need(root)
    return account


def _without(account: Account, roots: list[Item]) -> None:
    for root in roots:
        account.drop(root)
