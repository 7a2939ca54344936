"""Is the controller still right? Watches a running loop, with bounded work and memory a scan."""

from loopwright.serving.monitor.monitor import Monitor
from loopwright.serving.monitor.verdicts import Verdict

__all__ = ["Monitor", "Verdict"]
