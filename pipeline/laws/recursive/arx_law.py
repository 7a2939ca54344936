"""Shared parts of the laws that go on learning an ARX model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from loopwright.pipeline.errors import LawError, ModelError
from loopwright.pipeline.laws.base import require_kind
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.lagged.arx import ARX
from loopwright.pipeline.models.lagged.recursive import RecursiveLeastSquares
from loopwright.pipeline.models.lagged.recursive_arx import RecursiveArx
from loopwright.pipeline.plants.signals import Signals


def require_arx(models: Mapping[str, Model], law: str) -> ARX:
    """Part ``arx`` of a model set; raises LawError that says what the law needs and what the set has."""
    model = require_kind(models, ARX, law)
    if model.n_mv != 1 or model.delay != 1:
        raise LawError(
            f"law {law!r} needs a part 'arx' (kind arx, one MV, delay 1); "
            f"the model set's has {model.n_mv} MVs and delay {model.delay}"
        )
    return model


def estimator(
    law: str, signals: Signals, model: ARX, unit: float, params: Any, prefilter: Sequence[float] = (), lags: int = 0
) -> RecursiveArx:
    """The model as a law learns it on, of at least ``lags`` of y, with ``unit`` [mv] from ``signed_unit``.

    Raises LawError for wrong numbers.
    """
    try:
        rls = RecursiveLeastSquares(params.forgetting, params.covariance)
    except ModelError as error:
        raise LawError(f"law {law!r}: {error}") from error
    return RecursiveArx(model, signals.sp[0], signals.mv[0], unit, rls, prefilter, max(lags, model.n_y))
