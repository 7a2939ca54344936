"""Files of figures: a frozen dataclass as JSON, with a schema's number that its readers check."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

from loopwright.pipeline.config.params import parse
from loopwright.pipeline.errors import ParamsError, ReportError

T = TypeVar("T")
REMEDY = "run `dvc repro`, which writes it again"


def to_json(value: Any, schema: int) -> str:
    """The file's text; entries that equal their default are left out. ValueError for NaN and infinity."""
    return json.dumps({"schema": schema, **_plain(value)}, indent=1, allow_nan=False) + "\n"


def read_mapping(path: Path) -> dict[str, Any]:
    """The mapping in a JSON file; ReportError names what is wrong with it and the remedy."""
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ReportError(f"{path} cannot be read ({error}); {REMEDY}") from None
    if not isinstance(tree, dict):
        raise ReportError(f"{path} holds no mapping; {REMEDY}")
    return tree


def parsed(cls: type[T], tree: Mapping[str, Any], where: str, schema: int) -> T:
    """The mapping of such a file as ``cls``; ``where`` it is from is for the ReportError."""
    version, rest = tree.get("schema"), {key: value for key, value in tree.items() if key != "schema"}
    if version != schema:
        raise ReportError(f"{where} has schema {version!r}; this release reads schema {schema}: {REMEDY}")
    try:
        return parse(cls, rest, where)
    except ParamsError as error:
        raise ReportError(f"{error}; {REMEDY}") from None


def _plain(value: Any) -> Any:
    """Dataclasses, mappings and tuples as JSON has them."""
    if is_dataclass(value):
        return {f.name: _plain(v) for f in fields(value) if (v := getattr(value, f.name)) != _default(f)}
    if isinstance(value, Mapping):
        return {key: _plain(v) for key, v in value.items()}
    return [_plain(v) for v in value] if isinstance(value, tuple) else value


def _default(field: Any) -> Any:
    return field.default if field.default_factory is MISSING else field.default_factory()
