"""Why a predictive law moves, and what it would do: a second graph beside the controller's, that no loop steps."""

from loopwright.serving.explain.explainer import Explainer
from loopwright.serving.explain.explanation import Cause, ExplainedMove, Explanation, MovePart, SignalCourse, WhatIf

__all__ = ["Cause", "ExplainedMove", "Explainer", "Explanation", "MovePart", "SignalCourse", "WhatIf"]
