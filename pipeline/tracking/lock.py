"""dvc.lock, read as a list of stage results, and what identifies each of them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import yaml

from pipeline.errors import TrackingError


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
        content = {"cmd": self.cmd, "deps": self.deps, "params": self.params}
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


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
        raise TrackingError(f"{path} does not exist, so there is nothing to publish; run `dvc repro` first") from None
    except (yaml.YAMLError, KeyError, TypeError, AttributeError) as error:
        raise TrackingError(f"{path} is not a lock file of DVC ({error!r}); run `dvc repro` again") from error


def _stage(name: str, row: dict[str, Any]) -> StageResult:
    cmd = row["cmd"]
    params: dict[str, Any] = {}
    for values in (row.get("params") or {}).values():
        params |= flat(values)
    return StageResult(
        name=name,
        cmd=cmd if isinstance(cmd, str) else "\n".join(cmd),
        deps={d["path"]: _content_hash(d) for d in row.get("deps") or ()},
        params=params,
        outs={o["path"]: _content_hash(o) for o in row.get("outs") or ()},
    )


def _content_hash(row: dict[str, Any]) -> str:
    return str(row.get("md5") or json.dumps(row, sort_keys=True))


def is_current(result: StageResult, root: Path) -> bool:
    """Whether the outputs on disk are those that dvc.lock records.

    They are not while a stage runs, after it was killed, or after somebody edited a file.
    """
    return all((root / path).exists() and _md5(root / path) == md5 for path, md5 in result.outs.items())


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

    A record is an output of an excite stage, or a table (CSV, Parquet) that no stage made.
    """
    makers = {out: r for r in results for out in r.outs}

    def made(path: str) -> list[StageResult]:
        at = PurePosixPath(path)
        return [r for out, r in makers.items() if at.is_relative_to(out) or PurePosixPath(out).is_relative_to(at)]

    found: dict[str, str] = {}
    todo, seen = [result], set()
    while todo:
        stage = todo.pop()
        if stage.name in seen:
            continue
        seen.add(stage.name)
        if stage.kind == "excite":
            found |= stage.outs
            continue
        for path, md5 in stage.deps.items():
            above = made(path)
            todo += above
            if not above and PurePosixPath(path).suffix in {".csv", ".parquet"}:
                found[path] = md5
    return found


def dataset_hash(result: StageResult, results: Iterable[StageResult]) -> str:
    """sha256 over ``datasets``; "none" where there are none."""
    found = datasets(result, results)
    return hashlib.sha256(json.dumps(found, sort_keys=True).encode()).hexdigest() if found else "none"
