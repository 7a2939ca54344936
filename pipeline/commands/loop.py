"""``loopwright loop``: a controller on a real plant, over OPC UA; see ``loopwright.serving.station``."""

from loopwright.serving.station.command import options, run

__all__ = ["options", "run"]
