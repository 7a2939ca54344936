"""Loopwright's runtime: one .onnx file stepped as a controller. Needs numpy and onnxruntime, nothing else."""

from serving.clock import Clock, MonotonicClock, VirtualClock
from serving.controller import Step
from serving.endpoint import Endpoint, SimulatedEndpoint
from serving.errors import (
    ArtifactError,
    ContractError,
    EndpointError,
    LoopError,
    LoopwrightError,
    OutputError,
    SampleError,
    SignatureError,
)
from serving.fallback import Fallback
from serving.grid import RunReport
from serving.guard import Allowed, Complete, Fresh, Frozen, Guard, InRange, Rate, Sample, default_guards
from serving.loop import Command, ControlLoop, Mode
from serving.manifest import Manifest, Signal
from serving.trust import Controller
from serving.version import __version__ as __version__

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
