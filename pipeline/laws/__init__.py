"""Control laws by name: adding one is a file in this folder and a line here."""

from __future__ import annotations

from pipeline.laws.base import ControlLaw, LawSignals
from pipeline.laws.inverse import INC, INCAD, INCADEC
from pipeline.laws.inverse_dob import ForwardDob, InverseDob
from pipeline.laws.pid import PID

LAWS: dict[str, type[ControlLaw]] = {
    INC.name: INC,
    INCAD.name: INCAD,
    INCADEC.name: INCADEC,
    PID.name: PID,
    InverseDob.name: InverseDob,
    ForwardDob.name: ForwardDob,
}

__all__ = ["LAWS", "ControlLaw", "LawSignals"]
