"""The case's own experiment."""

from __future__ import annotations

from pipeline.cases.jacketed_batch_reactor.jacket_pulses import JacketPulses
from pipeline.excitation.base import Excitation

EXCITATIONS: dict[str, type[Excitation]] = {JacketPulses.kind: JacketPulses}
