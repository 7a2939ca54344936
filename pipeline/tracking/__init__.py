"""Tracking and registry: the only importer of mlflow and the only writer of its store.

``loopwright registry`` is its command.

The settings below stand in the package's own module because Python runs it before any of its
submodules, hence before mlflow is imported anywhere: mlflow reads them once, at import.
"""

from __future__ import annotations

import os

# Nothing is sent anywhere by importing the tools we use.
os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
os.environ.setdefault("DO_NOT_TRACK", "true")
os.environ.setdefault("DVC_NO_ANALYTICS", "true")
# A controller is an ONNX file; nothing that we load may be a pickle.
os.environ["MLFLOW_ALLOW_PICKLE_DESERIALIZATION"] = "false"
# A server that does not answer is one error after seconds, not after minutes of retries.
os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "10")
os.environ.setdefault("MLFLOW_HTTP_REQUEST_BACKOFF_FACTOR", "1")
os.environ.setdefault("MLFLOW_LOGGING_LEVEL", "WARNING")
os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")
