"""FMUs of shipped controllers, unpacked, and instances of them in fmpy: FMI 2.0 and 3.0 under the same calls."""

from __future__ import annotations

import atexit
import shutil
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import onnx
from kits import SHIPPED
from numpy.typing import NDArray

from loopwright.pipeline.export.plain_code.interpreter import run
from loopwright.pipeline.export.plain_code.lowering import lowered
from loopwright.pipeline.export.plain_code.statements import OUTPUT
from loopwright.pipeline.hosts.fmu.compiling import Toolchain, toolchain
from loopwright.pipeline.hosts.fmu.folder import write_folder
from loopwright.pipeline.hosts.fmu.law_sources import plain_answers
from loopwright.pipeline.plants.fmu.instance import NAMES
from loopwright.serving import Controller
from loopwright.serving.conformance.steps import OUTPUTS, StepResult, answered
from loopwright.serving.controller import Step

Array = NDArray[np.float64]
BOOLEAN = {"fault", "use_mv_applied", "use_fresh"}
MISSING = "" if shutil.which("cc") else "a C compiler is missing (apt install gcc)"


def file_of(name: str) -> Path:
    """A shipped controller by CASE/NAME."""
    return next(file for file in SHIPPED if file.parent.name + "/" + file.stem == name)


@cache
def controller_of(name: str) -> Controller:
    """Loaded once a process."""
    return Controller(file_of(name))


@cache
def answers_of(name: str, *, onnxruntime: bool = False) -> list[StepResult]:
    """The kit's steps, answered as an FMU must: by the statements of its plain C, or by onnxruntime."""
    return answered(controller_of(name)) if onnxruntime else plain_answers(controller_of(name))


@cache
def tools(*, onnxruntime: bool = False) -> Toolchain:
    """This machine's compiler and headers, for an FMU of plain C or with onnxruntime's library."""
    return toolchain(onnxruntime=onnxruntime)


@cache
def unpacked(name: str, fmi: int, *, onnxruntime: bool = False) -> Path:
    """The folder of an FMU, written once a process and removed at its end."""
    folder = Path(mkdtemp(prefix="controller-fmu-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    write_folder(controller_of(name), folder, fmi, tools(onnxruntime=onnxruntime))
    return folder


class PlainSteps:
    """A controller stepped by the statements of its plain C, run in Python."""

    def __init__(self, controller: Controller) -> None:
        self.controller, self.program = controller, lowered(onnx.load(controller.path))

    def step(self, **given: Any) -> Step:
        """One step: inputs as of ``Controller.step``; ``operate``, ``fresh`` and ``ahead`` have their usual values."""
        usual = self.controller.manifest.usual
        taken = {n: np.ravel(given[n] if n in given else usual(n)) for n in self.program.inputs}
        found = run(self.program, **taken)
        return Step(*(found.get(f"{OUTPUT}{name}", np.zeros(0)) for name in OUTPUTS))


class Unit:
    """An instance; ``said`` is what it logs."""

    def __init__(self, folder: Path, *, logging: bool = False) -> None:
        import fmpy.fmi2
        import fmpy.fmi3

        model = fmpy.read_model_description(str(folder))
        self.fmi = int(model.fmiVersion[0])
        self.references = {v.name: v.valueReference for v in model.modelVariables}
        self.said: list[str] = []
        names = {"guid": model.guid, "modelIdentifier": model.coSimulation.modelIdentifier}
        kind = fmpy.fmi2.FMU2Slave if self.fmi == 2 else fmpy.fmi3.FMU3Slave
        self.fmu: Any = kind(unzipDirectory=str(folder), instanceName="of a test", **names)
        if self.fmi == 2:  # not fmpy.instantiate_fmu, whose logger is one for all instances
            self._callbacks = fmpy.fmi2.fmi2CallbackFunctions()
            self._callbacks.logger = fmpy.fmi2.fmi2CallbackLoggerTYPE(self._hear)
            self.fmu.instantiate(callbacks=self._callbacks, loggingOn=logging)
        else:
            self.fmu.instantiate(logMessage=self._hear, loggingOn=logging)
        self.now = 0.0

    def _hear(self, *words: Any) -> None:
        self.said.append(words[-1].decode())

    def names(self, group: str) -> list[str]:
        """The variables of a group, in their order."""
        return [name for name in self.references if name.startswith(f"{group}.")]

    def begin(self, at: float = 0.0, **parameters: float) -> Unit:
        """Set parameters (dots in their names are ``__``), and initialize."""
        self.now = at
        if self.fmi == 2:
            self.fmu.setupExperiment(None, at)
            self.set(**parameters)
            self.fmu.enterInitializationMode()
        else:
            self.set(**parameters)
            self.fmu.enterInitializationMode(None, at)
        self.fmu.exitInitializationMode()
        return self

    def set(self, **values: Any) -> None:
        """A group gets an array, a variable a number."""
        for key, value in values.items():
            name = key.replace("__", ".")
            names = self.names(name) or [name]
            references = [self.references[n] for n in names]
            if name in BOOLEAN:
                self.fmu.setBoolean(references, [value])
            else:
                getattr(self.fmu, NAMES[self.fmi]["set"])(references, np.ravel(value).tolist())

    def get(self, group: str) -> Array:
        """The values of a group."""
        references = [self.references[name] for name in self.names(group)]
        return np.array(getattr(self.fmu, NAMES[self.fmi]["get"])(references) if references else [])

    @property
    def fault(self) -> bool:
        return bool(self.fmu.getBoolean([self.references["fault"]])[0])

    def step(self, length: float) -> None:
        self.fmu.doStep(self.now, length)
        self.now += length

    def written(self) -> bytes:
        """The state as bytes."""
        state = self.call("save")
        content = bytes(self.call("write", state))
        self.call("free", state)
        return content

    def read(self, content: bytes) -> None:
        """Go on from such bytes."""
        state = self.call("read", content)
        self.call("restore", state)
        self.call("free", state)

    def call(self, what: str, *arguments: Any) -> Any:
        """save, restore, free, write or read of a state."""
        return getattr(self.fmu, NAMES[self.fmi][what])(*arguments)

    def reset(self) -> None:
        self.fmu.reset()

    def close(self) -> None:
        self.fmu.freeInstance()
