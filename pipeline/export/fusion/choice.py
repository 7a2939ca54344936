"""The form of each value: the cheapest of some uniform preferences, then one by one while that pays."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from loopwright.pipeline.export.fusion.affine import AffineValue
from loopwright.pipeline.export.fusion.items import Items, SelectionPool
from loopwright.pipeline.export.fusion.plan import Account, FormChoice, Item, Member

PREFERENCES = (
    ("recipe", "selection", "elementwise", "segments", "increment", "row", "group"),
    ("selection", "elementwise", "gather", "squares", "increment", "recipe", "segments", "row", "group"),
    ("selection", "row", "group", "gather", "squares", "recipe", "segments", "increment", "elementwise"),
    ("selection", "squares", "recipe", "elementwise", "increment", "segments", "row", "group", "gather"),
    ("selection", "elementwise", "squares", "segments", "increment", "row", "group", "gather", "recipe"),
)
SWEEPS = 4  # over all choices, each with the others as they are
LEAST_GAIN_NS = 0.01  # ns


def choose(choices: list[FormChoice], roots: list[Item]) -> float:
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


def _sweep(account: Account, choices: list[FormChoice]) -> None:
    """One value after the other, latest first, again while that pays."""
    latest_first = sorted((c for c in choices if len(c.forms) > 1), key=lambda c: c.order, reverse=True)
    for _ in range(SWEEPS):
        before = account.total
        for choice in latest_first:
            if choice.count:
                _improve(account, choice)
        if account.total > before - LEAST_GAIN_NS:
            break


def _improve(account: Account, choice: FormChoice) -> None:
    """The cheapest form of one choice, the others as they are."""
    best, least = choice.kind, account.total
    for kind in choice.forms:
        if kind != best:
            account.choose(choice, kind)
            if account.total < least - LEAST_GAIN_NS:
                best, least = kind, account.total
    if choice.kind != best:
        account.choose(choice, best)


def _preferred(preference: tuple[str, ...], choices: list[FormChoice]) -> tuple[str, ...]:
    """The kind of form of each choice that comes first."""
    return tuple(next((k for k in preference if k in c.forms), next(iter(c.forms))) for c in choices)


def _with(kinds: tuple[str, ...], choices: list[FormChoice], roots: list[Item]) -> Account:
    account = Account()
    for choice, kind in zip(choices, kinds, strict=True):
        account.choose(choice, kind)
    for root in roots:
        account.need(root)
    return account


def _without(account: Account, roots: list[Item]) -> None:
    for root in roots:
        account.drop(root)


LATER_LEVELS = 3  # so much later at most


def postpone(items: Items, decided: Sequence[tuple[FormChoice, AffineValue]]) -> None:
    """Offer each value that can be a piece of its level's product the products of later levels too.

    A value may wait until the level below the lowest block that can depend on it in any form. So no choice makes a
    value depend on itself: blocks depend on products of lower levels alone, and products on blocks of their level
    and below.
    """
    first_user = _first_users(items)
    last = max((block.level for block in items.reading.blocks), default=0)
    for choice, value in decided:
        if "group" in choice.forms:
            end = min(first_user.get(id(choice), last + 1) - 1, value.level + LATER_LEVELS)
            for level in range(value.level + 1, end + 1):
                choice.forms[f"later {level - value.level}"] = items.member(value, level=level)


def _first_users(items: Items) -> dict[int, int]:
    """The lowest level of the blocks that can depend on a choice, by its id; without those that none depends on."""
    found: dict[int, int] = {}
    seen: set[int] = set()
    for block in sorted(items.reading.blocks, key=lambda b: b.level):
        stack = [items.block(block)]
        while stack:
            item = stack.pop()
            if id(item) in seen:
                continue
            seen.add(id(item))
            if isinstance(item, FormChoice):
                found[id(item)] = block.level
            stack.extend(_possible(item))
    return found


def _possible(item: Item) -> Iterable[Item]:
    """The inputs of an item, whatever is chosen; of a product only its pieces, whose blocks are known."""
    if isinstance(item, FormChoice):
        return item.forms.values()
    if isinstance(item, Member) and isinstance(item.pool, SelectionPool):
        return [item.pool.source]
    return item.uses
