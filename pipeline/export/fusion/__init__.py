"""Affine fusion: the affine parts of a graph as few matrix products, so that a law may be written as its formulas."""

from __future__ import annotations

import onnx

from loopwright.pipeline.export.fusion.choice import choose, postpone
from loopwright.pipeline.export.fusion.emission import Outputs, emitted
from loopwright.pipeline.export.fusion.forms import forms_of
from loopwright.pipeline.export.fusion.items import Items
from loopwright.pipeline.export.fusion.joining import joined
from loopwright.pipeline.export.fusion.lone_factors import with_factors_apart
from loopwright.pipeline.export.fusion.outer_products import without_turns
from loopwright.pipeline.export.fusion.plan import Item
from loopwright.pipeline.export.fusion.reading import GraphReading

LEAST_SAVING = 0.002
"""A graph must save this share of its price; else it stays as it is."""


def fused(model: onnx.ModelProto) -> onnx.ModelProto:
    """The same function with fewer operators; as it is, but for factors of one element, where nothing is gained.

    Values that are affine in the inputs and in the results of nonlinear operators are computed by few products, never
    by one that is dearer than what it replaces. Equal to the given graph but for the rounding. The graph must have
    static shapes and operators that a controller may have.
    """
    candidates = []
    together = joined(model)
    for given in (model,) if together is None else (model, together):
        for factors in (True, False):
            reading = GraphReading(given, factors=factors)
            items, outputs = listed(reading)
            after = choose(items.choices, [item for _, item in outputs if isinstance(item, Item)])
            candidates.append((after, items, outputs, reading))
            if not reading.without_factors:  # the next would be the same
                break
    after, items, outputs, _ = min(candidates, key=lambda c: c[0])
    if after > (1 - LEAST_SAVING) * candidates[0][3].price_before:
        return without_turns(with_factors_apart(model))
    return without_turns(emitted(items, outputs, model))


def listed(reading: GraphReading) -> tuple[Items, Outputs]:
    """All that the graph may be made of, and its outputs."""
    items = Items(reading)
    # Each behind its operands: asked for from the end, a long chain of them would be a deep recursion.
    for block in reading.blocks:
        items.block(block)
    outputs = [(name, items.of(operand)) for name, operand in reading.outputs]
    decided = []
    while items.undecided:
        choice, value = items.undecided.pop()
        choice.forms = forms_of(items, value)
        decided.append((choice, value))
    postpone(items, decided)
    return items, outputs
