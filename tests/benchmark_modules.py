"""The benchmarks as modules: they are scripts beside the packages. Not a test."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from types import ModuleType, SimpleNamespace

FOLDER = Path(__file__).parents[1] / "benchmarks"


@cache
def benchmark_script(name: str) -> ModuleType:
    """benchmarks/NAME.py as a module."""
    spec = importlib.util.spec_from_file_location(f"benchmark_of_{name}", FOLDER / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def own_plants_modules(names: Sequence[str]) -> SimpleNamespace:
    """Modules of benchmarks/own_plants by name."""
    return benchmark_modules(names, FOLDER / "own_plants")


def benchmark_modules(names: Sequence[str], folder: Path = FOLDER) -> SimpleNamespace:
    """Modules of a folder of scripts by name, beside what all benchmarks share; their names are free again then."""
    before = list(sys.path)
    sys.path.insert(0, str(folder))
    sys.path.append(str(FOLDER))
    try:
        return SimpleNamespace(**{name: importlib.import_module(name) for name in names})
    finally:
        sys.path[:] = before
        for name in names:
            sys.modules.pop(name, None)
