"""Why a predictive law moves, and what it would do: a second graph beside the controller's, that no loop steps."""

from loopwright.serving.explain.explainer import Explainer
from loopwright.serving.explain.explanation import Cause, Course, ExplainedMove, Explanation, MovePart, WhatIf

__all__ = ["Cause", "Course", "ExplainedMove", "Explainer", "Explanation", "MovePart", "WhatIf"]
