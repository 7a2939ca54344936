"""``loopwright loop``: a controller on a real plant, over OPC UA; see ``serving.station``."""

from serving.station.command import options, run

__all__ = ["options", "run"]
