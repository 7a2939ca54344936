"""Is the controller still right? Watches a running loop, with bounded work and memory a scan."""

from serving.monitor.monitor import Monitor
from serving.monitor.verdict import Verdict

__all__ = ["Monitor", "Verdict"]
