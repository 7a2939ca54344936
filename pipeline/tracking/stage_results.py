"""The results of the pipeline's stages: what dvc.lock says of each, what identifies it, and when it came about.

Outputs hold no time, so that an equal result is an equal file. When a stage ran, and for how long, stands in
its receipt, which ``loopwright.pipeline.engine.start`` writes.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import yaml

from loopwright.pipeline.engine.start import receipt_path
from loopwright.pipeline.errors import TrackingError
from loopwright.pipeline.files import digest
from loopwright.serving.explain.explain_file import explain_path

SLACK_S = 60.0
"""DVC may copy the outputs into its cache and back before its next stage starts."""


@dataclass(frozen=True, slots=True)
class StageResult:
    """One stage of dvc.lock: what it was run with and what came out.

    ``deps`` and ``outs`` map paths to DVC's content hashes, ``params`` is flat (dotted names).
    """

    name: str
    cmd: str
    deps: dict[str, str]
    params: dict[str, Any]
    outs: dict[str, str]

    @property
    def kind(self) -> str:
        """The stage without its item: ``fit`` of ``fit@tank-nnarx``."""
        return self.name.partition("@")[0]

    @property
    def case(self) -> str | None:
        """The case, by the folder of an output (work/<case>/ or artifacts/<case>/); None for publish."""
        for out in self.outs:
            parts = PurePosixPath(out).parts
            if len(parts) > 2 and parts[0] in {"work", "artifacts"}:
                return parts[1]
        return None

    @property
    def key(self) -> str:
        """sha256 of command, dependencies and parameters: equal keys mean the same result.

        Outputs are left out, so a stage that DVC restored from its cache has the key of the run
        that made it.
        """
        return digest({"cmd": self.cmd, "deps": self.deps, "params": self.params})

    @property
    def item(self) -> str:
        """The stage's item without its case: a record, a model set, a controller; the case for a report."""
        return self.name.partition("@")[2].removeprefix(f"{self.case}-")

    def files(self, root: Path) -> Iterator[tuple[Path, str | None]]:
        """Every file of the outputs, and the folder that it lies in, relative to the output; None for none."""
        for top in self._tops(root):
            for path in [top] if top.is_file() else sorted(p for p in top.rglob("*") if p.is_file()):
                folder = path.parent.relative_to(top if top.is_dir() else top.parent).as_posix()
                yield path, None if folder == "." else folder

    def controllers(self, root: Path) -> list[Path]:
        """The controller files of a validation: each beside its JSON file, whose digest stands for it in dvc.lock."""
        beside = {root / out for out in self.outs if self.kind == "validate" and out.startswith("artifacts/")}
        return sorted({path.with_suffix(".onnx") for path in beside if path.with_suffix(".onnx").is_file()})

    def _tops(self, root: Path) -> list[Path]:
        """Files and folders of the outputs, the controllers beside them, and the graphs that explain these."""
        controllers = self.controllers(root)
        explained = [path for path in map(explain_path, controllers) if path.is_file()]
        return list(dict.fromkeys([*(root / out for out in self.outs), *controllers, *explained]))

    def is_current(self, root: Path) -> bool:
        """Whether the outputs on disk are those that dvc.lock records.

        They are not while a stage runs, after it was killed, or after somebody edited a file.
        """
        return all((root / path).exists() and _md5(root / path) == md5 for path, md5 in self.outs.items())


@dataclass(frozen=True, slots=True)
class StageTimes:
    """Start and end of a stage in ms since 1970; where the duration is not known, both are when the files came.

    A receipt belongs to the files on disk only if they were written while that run lasted; files that DVC took
    from its cache have no duration.
    """

    start_ms: int
    end_ms: int
    measured: bool

    @classmethod
    def of(cls, result: StageResult, root: Path) -> StageTimes:
        """The times of the run that wrote the files of ``result``."""
        written = max((file.stat().st_mtime for file, _ in result.files(root)), default=0.0)
        try:
            row = json.loads(receipt_path(root, result.name).read_text(encoding="utf-8"))
            start, end = float(row["started"]), float(row["started"]) + float(row["seconds"])
            measured = start - 1.0 <= written <= end + SLACK_S  # a stage may end within the millisecond
        except (OSError, ValueError, KeyError, TypeError):
            measured = False
        if not measured:
            start = end = written
        return cls(round(1000 * start), round(1000 * end), measured)


def flat(tree: Any, prefix: str = "") -> dict[str, Any]:
    """Nested dictionaries as one, keys joined by dots; everything else is a leaf."""
    if not isinstance(tree, dict):
        return {prefix: tree}
    rows: dict[str, Any] = {}
    for key, value in tree.items():
        rows |= flat(value, f"{prefix}.{key}" if prefix else str(key))
    return rows


def read_lock(root: Path) -> list[StageResult]:
    """The stages of ``root/dvc.lock`` in its order; raises TrackingError where there is none."""
    path = root / "dvc.lock"
    try:
        stages = (yaml.safe_load(path.read_text()) or {})["stages"]
        return [_stage(name, row) for name, row in stages.items()]
    except FileNotFoundError:
        raise TrackingError(f"{path} does not exist, so nothing can be published; run `loopwright run` first") from None
    except (yaml.YAMLError, KeyError, TypeError, AttributeError) as error:
        raise TrackingError(f"{path} is not a lock file of DVC ({error!r}); restore it by git") from error


def _stage(name: str, row: dict[str, Any]) -> StageResult:
    deps, outs = (
        {file["path"]: str(file.get("md5") or json.dumps(file, sort_keys=True)) for file in row.get(key) or ()}
        for key in ("deps", "outs")
    )
    params = {k: v for values in (row.get("params") or {}).values() for k, v in flat(values).items()}
    return StageResult(name, row["cmd"] if isinstance(row["cmd"], str) else "\n".join(row["cmd"]), deps, params, outs)


def _md5(path: Path) -> str:
    """DVC's hash: md5 of a file; for a folder md5 of the JSON list of its files' hashes, and ".dir"."""
    if path.is_file():
        return hashlib.md5(path.read_bytes(), usedforsecurity=False).hexdigest()
    files = [p for p in path.rglob("*") if p.is_file()]
    rows = [{"md5": _md5(p), "relpath": p.relative_to(path).as_posix()} for p in files]
    rows.sort(key=lambda row: row["relpath"])
    listing = json.dumps(rows, sort_keys=True).encode()
    return hashlib.md5(listing, usedforsecurity=False).hexdigest() + ".dir"


def datasets(result: StageResult, results: Iterable[StageResult]) -> dict[str, str]:
    """Path -> content hash of the records that ``result`` descends from; none for a law from equations alone.

    A record is an output of a stage `screen` or `excite`, or a table (CSV, Parquet) that no stage made.
    """
    makers = {PurePosixPath(out): r for r in results for out in r.outs}
    records: dict[str, str] = {}
    todo, done = [result], set()
    while todo:
        stage = todo.pop()
        if stage.name in done:
            continue
        done.add(stage.name)
        if stage.kind in {"screen", "excite"}:
            records |= stage.outs
            continue
        for path, md5 in stage.deps.items():
            at = PurePosixPath(path)
            above = [r for out, r in makers.items() if at.is_relative_to(out) or out.is_relative_to(at)]
            todo += above
            if not above and at.suffix in {".csv", ".parquet"}:
                records[path] = md5
    return records


def dataset_hash(records: dict[str, str]) -> str:
    """sha256 over ``datasets``; "none" where there are none."""
    return digest(records) if records else "none"
