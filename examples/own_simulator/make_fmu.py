"""Compile aeration.c and pack aeration.fmu; the FMU beside it was made so, and it needs no compiler.

python examples/own_simulator/make_fmu.py
"""

from __future__ import annotations

import subprocess
import tempfile
import zipfile
from pathlib import Path

HERE = Path(__file__).parent
FLAGS = ("-shared", "-fPIC", "-O2", "-ffp-contract=off", "-fvisibility=hidden", "-s", "-Wl,-z,noseparate-code")
DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="aeration" guid="{aeration}" numberOfEventIndicators="0">
  <CoSimulation modelIdentifier="aeration" canHandleVariableCommunicationStepSize="true"
                canGetAndSetFMUstate="true" canSerializeFMUstate="true"/>
  <UnitDefinitions><Unit name="%"/><Unit name="mg/l"/><Unit name="mg/(l h)"/></UnitDefinitions>
  <DefaultExperiment startTime="0" stopTime="86400" stepSize="30"/>
  <ModelVariables>
    <ScalarVariable name="air" valueReference="0" causality="input" description="blower of the basin">
      <Real unit="%" min="0" max="100" start="40"/>
    </ScalarVariable>
    <ScalarVariable name="uptake" valueReference="1" causality="input" description="oxygen that the sludge takes">
      <Real unit="mg/(l h)" start="32"/>
    </ScalarVariable>
    <ScalarVariable name="oxygen" valueReference="2" causality="output" initial="calculated" description="probe">
      <Real unit="mg/l" min="0" max="9"/>
    </ScalarVariable>
  </ModelVariables>
  <ModelStructure>
    <Outputs><Unknown index="3"/></Outputs>
    <InitialUnknowns><Unknown index="3"/></InitialUnknowns>
  </ModelStructure>
</fmiModelDescription>
"""


def library(to: Path) -> None:
    """The shared library of this machine, by its C compiler."""
    subprocess.run(["cc", *FLAGS, "-o", str(to), str(HERE / "aeration.c")], check=True)


def pack(to: Path, description: str, binaries: dict[str, bytes]) -> None:
    """An FMU with a model description and the libraries of platforms; the same content gives the same bytes."""
    files = {"modelDescription.xml": description.encode()}
    files |= {f"binaries/{platform}": content for platform, content in binaries.items()}
    with zipfile.ZipFile(to, "w", zipfile.ZIP_DEFLATED) as made:
        for name, content in files.items():
            made.writestr(zipfile.ZipInfo(name, (2026, 1, 1, 0, 0, 0)), content, zipfile.ZIP_DEFLATED)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        compiled = Path(folder) / "aeration.so"
        library(compiled)
        pack(HERE / "aeration.fmu", DESCRIPTION, {"linux64/aeration.so": compiled.read_bytes()})
