"""Control laws by name: adding one is a file in this folder and a line here."""

from __future__ import annotations

from pipeline.laws.auto_pid_network import AutoPidNetwork
from pipeline.laws.base import ControlLaw, LawSignals
from pipeline.laws.fuzzy_feedforward import FuzzyFeedforward
from pipeline.laws.fuzzy_feedforward_observer import FuzzyFeedforwardObserver
from pipeline.laws.fuzzy_feedforward_pi import FuzzyFeedforwardPi
from pipeline.laws.gauss_newton_pid import GaussNewtonPid
from pipeline.laws.inverse import INC, INCAD, INCADEC
from pipeline.laws.inverse_dob import ForwardDob, InverseDob
from pipeline.laws.linearized_pid import LinearizedPid
from pipeline.laws.local_pid_network import LocalPidNetwork
from pipeline.laws.minimum_variance import MinimumVariance
from pipeline.laws.model_reference import ModelReference
from pipeline.laws.model_reference_two_error import ModelReferenceTwoError
from pipeline.laws.pi_reference import PiReference
from pipeline.laws.pid import PID
from pipeline.laws.recursive_pid import RecursivePid
from pipeline.laws.self_tuning_pid import SelfTuningPid

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
}

__all__ = ["LAWS", "ControlLaw", "LawSignals"]
