"""The version, in this one place: the build, ``loopwright --version`` and every controller's provenance go by it."""

__version__ = "0.1.0"
