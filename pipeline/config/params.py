"""The sections of params.yaml as frozen dataclasses, and new entries written into its text."""

from __future__ import annotations

import dataclasses
import functools
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml

from loopwright.pipeline.config.operator_tests import OperatedTestParams, check_names
from loopwright.pipeline.config.reading import tree_of
from loopwright.pipeline.errors import ParamsError, nearest
from loopwright.pipeline.files import write_bytes
from loopwright.serving import fields
from loopwright.serving.certificate import loops_without_failure

T = TypeVar("T")
PARAMS_FILE = Path("params.yaml")
MOST_CONFIDENCE = 99.9999  # [%] of a certificate
MOST_FAILING = 0.5  # share of the plants: a certificate that cannot show so few failures says nothing
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
class CertificateParams:
    """``cases.<case>.certificate``: how many loops of which plants a certificate rests on, and what a failure is.

    ``loops`` closed loops of each shipped file, 0: no certificate. ``confidence`` [%]. ``spread`` [%] of a parameter of
    the plant without a stated range, ``faults`` [%] of the loops with a fault of an actuator. ``limits``: figure ->
    value above which a loop fails too; ``swings``: whether one fails that swings to the end.
    """

    loops: int = 90  # without a failure at most 5 % fail, with 99 % confidence
    confidence: float = 99.0
    spread: float = 2.0
    faults: float = 50.0
    limits: Mapping[str, float] = dataclasses.field(default_factory=dict)
    swings: bool = False

    def __post_init__(self) -> None:
        if not 50 <= self.confidence <= MOST_CONFIDENCE:
            raise ValueError(f"confidence is {self.confidence:g} %; it must be from 50 to {MOST_CONFIDENCE} %")
        for name in ("spread", "faults"):
            if not 0 <= getattr(self, name) <= 100:
                raise ValueError(f"{name} is {getattr(self, name):g} %; it must be from 0 to 100 %")
        least = loops_without_failure(MOST_FAILING, self.confidence / 100)
        if self.loops and self.loops < least:
            raise ValueError(
                f"loops is {self.loops}, too few to say anything: even where none fails, more than "
                f"{100 * MOST_FAILING:g} % may; give {least} or more (459 can show 1 % with 99 % confidence)"
            )


@dataclasses.dataclass(frozen=True, slots=True)
class CaseParams:
    """``cases.<case>``: what validation and report need beyond the case's own text.

    ``operated`` are further tests of laws with ``operate``, by name. ``certificate`` says on which closed loops the
    certificate of each shipped file rests.
    """

    held_out_seeds: tuple[int, ...]
    noise_seed: int = 0
    certificate: CertificateParams = CertificateParams()
    operated: Mapping[str, OperatedTestParams] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        check_names(tuple(self.operated))


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


Entries = Mapping[str, Mapping[str, Any]]
"""Section -> name of the entry -> its values."""


def add_entries(
    entries: Entries, path: Path = PARAMS_FILE, *, replace: bool = False, remove: Iterable[tuple[str, str]] = ()
) -> None:
    """Add entries to the ends of their sections, a section that is missing at the end of the file; all or nothing.

    ``replace`` takes entries of the same names out first, ``remove`` further ones: (section, name), if they are there.
    Raises ParamsError where an entry of that name exists without it, or where a section is not written as a block.
    """
    try:
        text = path.read_bytes().decode("utf-8")
        before = tree_of(text, path)
    except FileNotFoundError:
        raise ParamsError(f"{path} is not here; run from the repository's root") from None
    except UnicodeDecodeError as error:
        raise ParamsError(f"{path} is not YAML in UTF-8: {error}") from None
    wanted, end = dict(before), "\r\n" if "\r\n" in text else "\n"
    taken = [
        (section, name) for section, added in entries.items() for name in added if name in (before.get(section) or ())
    ]
    if taken and not replace:
        section, name = min(taken)
        raise ParamsError(f"{path}: {section} has {name!r} already; remove it, or choose another name")
    further = [(section, name) for section, name in remove if name in (before.get(section) or ())]
    for section, name in dict.fromkeys([*taken, *further]):
        left = _without(text, section, name)
        if left == text:
            raise ParamsError(f"{path}: {section}.{name} is not written as a block; remove it by hand")
        text = left
        wanted[section] = {key: value for key, value in wanted[section].items() if key != name}
        if not wanted[section] and section not in entries:
            text = re.sub(rf"^{re.escape(section)}:", f"{section}: {{}}", text, flags=re.MULTILINE)
    for section, added in entries.items():
        wanted[section] = {**(wanted.get(section) or {}), **added}
        text = _with_lines(text, section, _lines(added), end)
    try:
        after = yaml.safe_load(text)
    except yaml.YAMLError:
        after = None
    if after != wanted:
        raise ParamsError(
            f"{path}: {', '.join(entries)} cannot be extended: write each of these sections as a block, a line for "
            "each entry, without braces"
        )
    mode = path.stat().st_mode & 0o777
    write_bytes(path.resolve(), text.encode("utf-8"))
    os.chmod(path, mode)


def _lines(added: Mapping[str, Any]) -> list[str]:
    text: str = yaml.safe_dump(dict(added), sort_keys=False, allow_unicode=True, default_flow_style=None, width=10_000)
    return [f"  {line}" for line in text.splitlines()]


def _without(text: str, section: str, name: str) -> str:
    """The text without an entry: its line and the deeper lines below it; comments above it and behind it stay."""
    lines = text.splitlines(keepends=True)
    heads = [i for i, line in enumerate(lines) if line[:1].isalpha()]
    at = next((i for i in heads if lines[i].split(":")[0].strip() == section), len(lines))
    end = next((i for i in heads if i > at), len(lines))
    key = re.compile(rf"( +)(['\"]?){re.escape(name)}\2\s*:")
    first = next((i for i in range(at + 1, end) if key.match(lines[i])), None)
    if first is None:
        return text
    depth, last = len(lines[first]) - len(lines[first].lstrip()), first
    for i in range(first + 1, end):
        if lines[i].strip():
            if len(lines[i]) - len(lines[i].lstrip()) <= depth:
                break
            last = i
    return "".join([*lines[:first], *lines[last + 1 :]])


def _with_lines(text: str, section: str, added: list[str], end: str) -> str:
    """The text with lines behind the last one of a section; with a new section where there is none."""
    lines = text.splitlines(keepends=True)
    heads = [i for i, line in enumerate(lines) if line[:1].isalpha()]
    at = next((i for i in heads if lines[i].split(":")[0].strip() == section), None)
    if at is None:
        return text + ("" if not text or text.endswith("\n") else end) + end.join(["", f"{section}:", *added, ""])
    stop = next((i for i in heads if i > at), len(lines))
    # Blank lines and comments at the margin belong to the next section.
    while stop > at + 1 and (not lines[stop - 1].strip() or lines[stop - 1].startswith("#")):
        stop -= 1
    if not lines[stop - 1].endswith("\n"):
        lines[stop - 1] += end
    if stop == at + 1 and lines[at].rstrip().endswith("{}"):
        lines[at] = lines[at].rstrip()[:-2].rstrip() + end
    return "".join([*lines[:stop], end.join([*added, ""]), *lines[stop:]])
