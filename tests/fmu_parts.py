"""Real FMUs for tests: the example's, and the same library described otherwise. None of them needs a compiler here."""

from __future__ import annotations

import importlib.util
import platform
import sys
import tempfile
from functools import cache
from pathlib import Path
from types import ModuleType

from loopwright.pipeline.plants.fmu.description import FmuRow, FmuTable
from loopwright.pipeline.plants.simulator_file import FileSimulator
from loopwright.serving.manifest import Signal

EXAMPLES = Path(__file__).parents[1] / "examples" / "own_simulator"
EXAMPLE = EXAMPLES / "aeration.fmu"
TABLE = FmuTable(
    30.0,
    (
        FmuRow("oxygen", "pv", Signal("oxygen", "mg/l", 0.0, 9.0)),
        FmuRow("air", "mv", Signal("air", "%", 0.0, 100.0)),
        FmuRow("uptake", "dv", Signal("uptake", "mg/(l h)", 24.0, 40.0)),
    ),
)
FMI_3 = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="aeration" instantiationToken="{aeration}">
  <CoSimulation modelIdentifier="aeration" canHandleVariableCommunicationStepSize="true"
                canGetAndSetFMUState="true" canSerializeFMUState="true"/>
  <TypeDefinitions><Float64Type name="percent" unit="%" min="0" max="100"/></TypeDefinitions>
  <DefaultExperiment startTime="0" stepSize="30"/>
  <ModelVariables>
    <Float64 name="time" valueReference="9" causality="independent" variability="continuous"/>
    <Float64 name="air" valueReference="0" causality="input" declaredType="percent" start="40"/>
    <Float64 name="uptake" valueReference="1" causality="input" start="32" unit="mg/(l h)"/>
    <Float64 name="oxygen" valueReference="2" causality="output" initial="calculated" unit="mg/l" min="0" max="9"/>
    <Int32 name="blowers" valueReference="3" causality="parameter" start="2"/>
  </ModelVariables>
  <ModelStructure><Output valueReference="2"/><InitialUnknown valueReference="2"/></ModelStructure>
</fmiModelDescription>
"""
WRITES_2, WRITES_3 = ' canSerializeFMUstate="true"', ' canSerializeFMUState="true"'
KEEPS_2, KEEPS_3 = 'canGetAndSetFMUstate="true"', 'canGetAndSetFMUState="true"'


@cache
def made() -> ModuleType:
    """The example's script."""
    spec = importlib.util.spec_from_file_location("make_fmu", EXAMPLES / "make_fmu.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


FMI_2: str = made().DESCRIPTION


@cache
def library() -> bytes:
    """The library of the example, which runs on Linux on x86; elsewhere it is compiled."""
    if sys.platform == "linux" and platform.machine() == "x86_64":
        import zipfile

        with zipfile.ZipFile(EXAMPLE) as content:
            return content.read("binaries/linux64/aeration.so")
    with tempfile.TemporaryDirectory() as folder:
        made().library(Path(folder) / "aeration")
        return (Path(folder) / "aeration").read_bytes()


def fmu(folder: Path, description: str = FMI_2, *, library: bytes | None = None, name: str = "plant.fmu") -> Path:
    """An FMU for this machine; ``library`` in the place of the example's."""
    import fmpy

    binary = f"aeration{fmpy.sharedLibraryExtension}"
    content = globals()["library"]() if library is None else library
    made().pack(folder / name, description, {f"{p}/{binary}": content for p in (fmpy.platform, fmpy.platform_tuple)})
    return folder / name


def plant(path: Path, every: int = 1, table: FmuTable = TABLE) -> FileSimulator:
    """The FMU as a plant."""
    return FileSimulator(path, "aeration", every, table)
