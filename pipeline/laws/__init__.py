"""Control laws by name: adding one is a file in a family's folder and a line here. Export makes them fast."""

from __future__ import annotations

from pipeline.laws.base import ControlLaw
from pipeline.laws.fuzzy.fuzzy_feedforward import FuzzyFeedforward, FuzzyFeedforwardPi
from pipeline.laws.fuzzy.fuzzy_feedforward_observer import FuzzyFeedforwardObserver
from pipeline.laws.inverse.inverse import INC, INCAD, INCADEC
from pipeline.laws.inverse.inverse_dob import ForwardDob, InverseDob
from pipeline.laws.linearized.gauss_newton import GaussNewtonPid, MinimumVariance
from pipeline.laws.linearized.linearized_pid import LinearizedPid
from pipeline.laws.local.pid_networks import AutoPidNetwork, LocalPidNetwork
from pipeline.laws.pid.pid import PID
from pipeline.laws.predictive.predictive import Predictive
from pipeline.laws.recursive.recursive_pid import RecursivePid
from pipeline.laws.recursive.self_tuning_pid import SelfTuningPid
from pipeline.laws.reference.model_reference import ModelReference, ModelReferenceTwoError
from pipeline.laws.reference.pi_reference import PiReference

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
