"""Plants by name: adding one is a file in this folder and a line here."""

from __future__ import annotations

from pipeline.plants.base import Linearization, Plant
from pipeline.plants.thiosulfate_cstr import ThiosulfateCstr

PLANTS: dict[str, type[Plant]] = {
    ThiosulfateCstr.name: ThiosulfateCstr,
}

__all__ = ["PLANTS", "Linearization", "Plant"]
