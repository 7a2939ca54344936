"""Values that nothing waits for yet, computed with those of a later level."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from loopwright.pipeline.export.fusion.items import Items
from loopwright.pipeline.export.fusion.plan import Choice, Item, Member
from loopwright.pipeline.export.fusion.pools import Selection
from loopwright.pipeline.export.fusion.values import Value

LEVELS = 3  # so much later at most


def postpone(items: Items, decided: Sequence[tuple[Choice, Value]]) -> None:
    """Offer each value that can be a piece of its level's product the products of later levels too.

    A value may wait until the level below the lowest block that can depend on it in any form. So no choice makes a
    value depend on itself: blocks depend on products of lower levels alone, and products on blocks of their level
    and below.
    """
    first_user = _first_users(items)
    last = max((block.level for block in items.reading.blocks), default=0)
    for choice, value in decided:
        if "group" in choice.forms:
            end = min(first_user.get(id(choice), last + 1) - 1, value.level + LEVELS)
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
            if isinstance(item, Choice):
                found[id(item)] = block.level
            stack.extend(_possible(item))
    return found


def _possible(item: Item) -> Iterable[Item]:
    """The inputs of an item, whatever is chosen; of a product only its pieces, whose blocks are known."""
    if isinstance(item, Choice):
        return item.forms.values()
    if isinstance(item, Member) and isinstance(item.pool, Selection):
        return [item.pool.source]
    return item.uses
