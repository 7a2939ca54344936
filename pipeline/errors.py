"""Errors between a plant and a published controller.

LoopwrightError (serving)
+-- PipelineError
    +-- ParamsError       params.yaml: an unknown key, a wrong type, a value out of range
    +-- PlantError        a plant cannot do what was asked: no steady state there, wrong shape
    +-- RecordError       a record's file: missing column, wrong unit, NaN, time not uniform, too short
    +-- ModelError        training data or a stored model do not fit the model
    +-- LawError          a control law cannot be designed from what it was given
    |   +-- WithheldError  nor for this plant of a person, whose other controllers go on
    +-- ExportError       a law cannot be written as one graph, or the graph differs from the law
    +-- HostError        a controller file cannot be made ready for another host: no compiler, a name it cannot have
    +-- NotMeasuredError  evaluation.evidence: a check or a picture needs a figure that was not measured
    +-- ReportError       a report lacks a stage's results, or cannot read them
    +-- TrackingError     the MLflow store or registry cannot be read or written
"""

from __future__ import annotations

from loopwright.serving.errors import LoopwrightError
from loopwright.serving.fields import nearest

__all__ = [
    "ExportError",
    "HostError",
    "LawError",
    "ModelError",
    "ParamsError",
    "PipelineError",
    "PlantError",
    "RecordError",
    "ReportError",
    "TrackingError",
    "WithheldError",
    "nearest",
]


class PipelineError(LoopwrightError):
    """Base of the pipeline's errors."""


class ParamsError(PipelineError):
    """params.yaml does not say what it must."""


class PlantError(PipelineError):
    """A plant was asked for something that it cannot give."""


class RecordError(PipelineError):
    """A record's data or file cannot be used."""


class ModelError(PipelineError):
    """A model cannot be trained, stored or loaded."""


class LawError(PipelineError):
    """A control law cannot be designed."""


class WithheldError(LawError):
    """A law does not suit a person's own plant; the plant's other controllers go on without it."""


class ExportError(PipelineError):
    """A law cannot be exported, or its graph differs from it."""


class HostError(PipelineError):
    """A controller file cannot be made ready for another host."""


class ReportError(PipelineError):
    """The stages left nothing that a report could be made of."""


class TrackingError(PipelineError):
    """The tracking store or the registry refused."""
