"""Loopwright's runtime: one .onnx file stepped as a controller. Needs numpy and onnxruntime, nothing else."""

from loopwright.serving.clock import Clock, MonotonicClock, VirtualClock
from loopwright.serving.controller import Step
from loopwright.serving.endpoint import Endpoint, SimulatedEndpoint
from loopwright.serving.errors import (
    ArtifactError,
    ContractError,
    EndpointError,
    LoopError,
    LoopwrightError,
    OutputError,
    SampleError,
    SignatureError,
)
from loopwright.serving.guard import Allowed, Complete, Fresh, Frozen, Guard, InRange, Rate, Sample, default_guards
from loopwright.serving.loop import Command, ControlLoop, Mode
from loopwright.serving.manifest import Manifest, Signal
from loopwright.serving.modes import Fallback
from loopwright.serving.scan_grid import RunReport
from loopwright.serving.trust import Controller
from loopwright.serving.version import __version__ as __version__

__all__ = [
    "Allowed",
    "ArtifactError",
    "Clock",
    "Command",
    "Complete",
    "ContractError",
    "ControlLoop",
    "Controller",
    "Endpoint",
    "EndpointError",
    "Fallback",
    "Fresh",
    "Frozen",
    "Guard",
    "InRange",
    "LoopError",
    "LoopwrightError",
    "Manifest",
    "Mode",
    "MonotonicClock",
    "OutputError",
    "Rate",
    "RunReport",
    "Sample",
    "SampleError",
    "Signal",
    "SignatureError",
    "SimulatedEndpoint",
    "Step",
    "VirtualClock",
    "default_guards",
]
