"""params.yaml -> frozen dataclasses; every mistake in it is one clear error."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from loopwright.pipeline.config.reading import tree_of
from loopwright.pipeline.errors import ParamsError, nearest
from loopwright.serving import fields

T = TypeVar("T")
PARAMS_FILE = Path("params.yaml")
OPTIONAL = {"exports", "plants"}  # sections that may be left out


def read_section(kind: str, name: str, path: Path = PARAMS_FILE) -> dict[str, Any]:
    """The mapping ``kind: {name: ...}`` of params.yaml; raises ParamsError where it is not there."""
    entry = _entry(_entry(_tree(path), kind, str(path)), name, f"{path}: {kind}")
    if not isinstance(entry, dict):
        raise ParamsError(f"{path}: {kind}.{name} is {entry!r}; it must be a mapping")
    return entry


def sections(kind: str, path: Path = PARAMS_FILE) -> tuple[str, ...]:
    """Names of all sections of one kind (cases, exports, records, models, controllers, plants), in their order.

    ``exports`` and ``plants`` may be left out.
    """
    tree = _tree(path)
    if kind in OPTIONAL and kind not in tree:
        return ()
    section = _entry(tree, kind, str(path))
    if not isinstance(section, dict):
        raise ParamsError(f"{path}: {kind} is {section!r}; it must be a mapping of names to their sections")
    return tuple(map(str, section))


@functools.lru_cache(maxsize=4)
def _parsed(text: str, path: Path) -> dict[str, Any]:
    """Whoever checks every section asks for the same text again and again."""
    return tree_of(text, path)


def _tree(path: Path) -> dict[str, Any]:
    try:
        return _parsed(path.read_text(encoding="utf-8"), path)
    except FileNotFoundError:
        raise ParamsError(f"{path} is not here; run from the repository's root") from None
    except UnicodeDecodeError as error:
        raise ParamsError(f"{path} is not YAML in UTF-8: {error}") from None


def entries(kind: str, case: str, field: str, path: Path = PARAMS_FILE) -> tuple[str, ...]:
    """The values of ``field`` in the entries that the section ``kind`` has for ``case``, in their order."""
    return tuple(
        str(_entry(_tree(path)[kind][name], field, f"{path}: {kind}.{name}")) for name in sections_of(kind, case, path)
    )


def sections_of(kind: str, case: str, path: Path = PARAMS_FILE) -> tuple[str, ...]:
    """Names of the sections of one kind that belong to ``case``, in their order."""
    found = (_tree(path).get(kind) or {}).items()
    return tuple(str(name) for name, e in found if isinstance(e, dict) and e.get("case") == case)


def _entry(tree: Mapping[str, Any], key: str, where: str) -> Any:
    if not isinstance(tree, dict) or key not in tree:
        raise ParamsError(f"{where} has no {key!r}{nearest(key, tree if isinstance(tree, dict) else ())}")
    return tree[key]


def choose(table: Mapping[str, T], word: object, what: str, where: str = "") -> T:
    """``table[word]``; raises ParamsError that names the nearest known word, and ``where`` the wrong one stands."""
    if not isinstance(word, str) or word not in table:
        place = f"{where}: " if where else ""
        raise ParamsError(f"{place}unknown {what} {word!r}{nearest(word, table)}")
    return table[word]


def parse(cls: type[T], values: Mapping[str, Any], where: str) -> T:
    """``values`` as the dataclass ``cls``; ParamsError, see ``loopwright.serving.fields``."""
    return fields.parse(cls, values, where, ParamsError)


# ---------------------------------------------------------------- the sections


@dataclasses.dataclass(frozen=True, slots=True)
class CaseParams:
    """``cases.<case>``: what validation and report need beyond the case's own text."""

    held_out_seeds: tuple[int, ...]
    noise_seed: int = 0


@dataclasses.dataclass(frozen=True, slots=True)
class RecordParams:
    """``records.<name>``: whose data, which seeds, and which excitation with its own numbers."""

    case: str
    record: str
    seeds: tuple[int, ...]
    kind: str
    excitation: Mapping[str, Any]

    def __post_init__(self) -> None:
        if not self.seeds or len(set(self.seeds)) < len(self.seeds):
            raise ValueError(f"seeds is {list(self.seeds)}; give one or more different seeds, one record each")

    @classmethod
    def read(cls, name: str) -> RecordParams:
        """The section of one record; ParamsError where the section is not called by its case and record."""
        params = _with_rest(cls, read_section("records", name), "excitation", f"records.{name}")
        _checked_key(name, "records", params.case, "record", params.record)
        return params


@dataclasses.dataclass(frozen=True, slots=True)
class ModelParams:
    """``models.<name>``: a set of models learnt from the same data, one set a data seed."""

    case: str
    model: str
    data: Path
    parts: Mapping[str, Mapping[str, Any]]

    @classmethod
    def read(cls, name: str) -> ModelParams:
        """The section of one model set; ParamsError where the section is not called by its case and model."""
        params = parse(cls, read_section("models", name), f"models.{name}")
        _checked_key(name, "models", params.case, "model", params.model)
        return params


@dataclasses.dataclass(frozen=True, slots=True)
class ControllerParams:
    """``controllers.<case>-<name>``: a law, its models, its numbers; ``variants`` are evaluated beside it.

    ``name`` is the controller's own: of its file, its DVC target and its registered model. Two of one law may
    stand in one case.

    ``as_printed`` marks the reproduction of a paper's law: it alone is shipped although it locked up in a test.
    """

    case: str
    name: str
    law: str
    model: str
    settings: Mapping[str, Any]
    variants: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    as_printed: bool = False

    @classmethod
    def read(cls, name: str) -> ControllerParams:
        """The section of one controller; ParamsError where the section is not called by its case and name."""
        params = _with_rest(cls, read_section("controllers", name), "settings", f"controllers.{name}")
        _checked_key(name, "controllers", params.case, "name", params.name)
        return params


def _checked_key(name: str, section: str, case: str, field: str, own: str) -> None:
    """ParamsError unless the key of an entry is ``<case>-<own>``, which files and DVC targets go by."""
    if name != (wanted := f"{case}-{own}"):
        raise ParamsError(
            f"{section}.{name} has `case: {case}` and `{field}: {own}`; correct these, or call the section {wanted}"
        )


def _with_rest(cls: type[T], section: Mapping[str, Any], rest: str, where: str) -> T:
    """``section`` as ``cls``; the keys that ``cls`` does not know go into its field ``rest``."""
    own = {f.name for f in dataclasses.fields(cls)} - {rest}  # type: ignore[arg-type]
    common = {k: v for k, v in section.items() if k in own}
    common[rest] = {k: v for k, v in section.items() if k not in own}
    return parse(cls, common, where)
