"""Control laws by name: adding one is a file in a family's folder and a line here. Export makes them fast."""

from __future__ import annotations

from loopwright.pipeline.laws.base import ControlLaw
from loopwright.pipeline.laws.fuzzy.fuzzy_feedforward import FuzzyFeedforward, FuzzyFeedforwardPi
from loopwright.pipeline.laws.fuzzy.fuzzy_feedforward_observer import FuzzyFeedforwardObserver
from loopwright.pipeline.laws.inverse.inverse import INC, INCAD, INCADEC
from loopwright.pipeline.laws.inverse.inverse_dob import ForwardDob, InverseDob
from loopwright.pipeline.laws.linearized import GaussNewtonPid, LinearizedPid, MinimumVariance
from loopwright.pipeline.laws.local.pid_networks import AutoPidNetwork, LocalPidNetwork
from loopwright.pipeline.laws.pid.pid import PID
from loopwright.pipeline.laws.predictive.predictive import Predictive
from loopwright.pipeline.laws.recursive import RecursivePid, SelfTuningPid
from loopwright.pipeline.laws.reference.model_reference import ModelReference, ModelReferenceTwoError
from loopwright.pipeline.laws.reference.pi_reference import PiReference

LAWS: dict[str, type[ControlLaw]] = {
    INC.name: INC,
    INCAD.name: INCAD,
    INCADEC.name: INCADEC,
    PID.name: PID,
    LocalPidNetwork.name: LocalPidNetwork,
    AutoPidNetwork.name: AutoPidNetwork,
    ModelReference.name: ModelReference,
    ModelReferenceTwoError.name: ModelReferenceTwoError,
    PiReference.name: PiReference,
    LinearizedPid.name: LinearizedPid,
    GaussNewtonPid.name: GaussNewtonPid,
    MinimumVariance.name: MinimumVariance,
    RecursivePid.name: RecursivePid,
    SelfTuningPid.name: SelfTuningPid,
    FuzzyFeedforward.name: FuzzyFeedforward,
    FuzzyFeedforwardPi.name: FuzzyFeedforwardPi,
    FuzzyFeedforwardObserver.name: FuzzyFeedforwardObserver,
    InverseDob.name: InverseDob,
    ForwardDob.name: ForwardDob,
    Predictive.name: Predictive,
}

__all__ = ["LAWS", "ControlLaw"]
