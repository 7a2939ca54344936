"""Loopwright's runtime: one .onnx file stepped as a controller. Needs numpy and onnxruntime, nothing else."""

from serving.controller import Controller, Step
from serving.errors import (
    ArtifactError,
    ContractError,
    EndpointError,
    LoopError,
    LoopwrightError,
    OutputError,
    SampleError,
)
from serving.manifest import Manifest, Signal

__all__ = [
    "ArtifactError",
    "ContractError",
    "Controller",
    "EndpointError",
    "LoopError",
    "LoopwrightError",
    "Manifest",
    "OutputError",
    "SampleError",
    "Signal",
    "Step",
]
