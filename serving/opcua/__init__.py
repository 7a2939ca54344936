"""A plant behind an OPC UA server. Needs asyncua: ``pip install 'loopwright[plant]'``."""

from loopwright.serving.opcua.endpoint import OpcUaEndpoint
from loopwright.serving.opcua.settings import HandBack, ModeNode, Nodes, Point, Server

__all__ = ["HandBack", "ModeNode", "Nodes", "OpcUaEndpoint", "Point", "Server"]
