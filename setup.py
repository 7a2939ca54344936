"""The packages of the distribution: folders ``pipeline`` and ``serving`` as parts of the name ``loopwright``."""

from setuptools import find_packages, setup

setup(packages=[f"loopwright.{name}" for name in find_packages(include=["pipeline*", "serving*"])])
