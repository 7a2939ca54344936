"""Where the tracking store is, and what to say when it does not answer."""

from __future__ import annotations

import os
import re
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import cache
from pathlib import Path
from urllib.request import url2pathname

import mlflow
import requests
from mlflow import MlflowClient
from mlflow.exceptions import MlflowException
from mlflow.store.db import utils as database
from sqlalchemy.exc import SQLAlchemyError

from loopwright.pipeline.errors import TrackingError

LOCAL = "mlflow.db"
FILES = "mlruns"
"""Folder of the artifacts, beside the database."""
LOCATIONS = (
    ("experiments", "artifact_location"),
    ("runs", "artifact_uri"),
    ("logged_models", "artifact_location"),
    ("model_versions", "source"),
    ("model_versions", "storage_location"),
)
"""Table and column of every absolute place that mlflow stores."""


def store_uri() -> str:
    """MLFLOW_TRACKING_URI, or the file mlflow.db of the current folder.

    The path is absolute, because mlflow keeps one open store for each different text.
    """
    return os.environ.get("MLFLOW_TRACKING_URI") or f"sqlite:///{Path(LOCAL).resolve().as_posix()}"


@contextmanager
def store() -> Iterator[MlflowClient]:
    """A client of the store, created or migrated before its first use.

    Raises
    ------
    TrackingError
        In one line, whatever mlflow, its database or the network raised inside.
    """
    uri = store_uri()
    try:
        if uri.startswith("sqlite:") and _database(uri).exists() and _database(uri).stat().st_size:
            _migrate(uri)
            _follow(_database(uri))
        mlflow.set_tracking_uri(uri)
        mlflow.set_registry_uri(uri)
        client = MlflowClient(uri)
        client.search_experiments(max_results=1)
        yield client
    except (MlflowException, SQLAlchemyError, sqlite3.Error, requests.RequestException) as error:
        raise TrackingError(f"the tracking store {uri} refused: {one_line(error)}; {_remedy(uri)}") from error


def one_line(error: Exception) -> str:
    """The message of mlflow, without the stack of the HTTP library that it quotes in several lines."""
    said, _, stack = " ".join(str(error).split()).partition(" failed with exception")
    # It retries an answer of 500 and the like, and tells a server that does not answer from this one only in there.
    own = re.search(r"too many (50\d) error responses", stack)
    return f"{said[:300]}{f' was answered by error {own[1]}' if own else ''}"


def missing_file(error: Exception) -> str:
    """The remedy for a file of a run that the store does not give, in words."""
    if store_uri().startswith("http"):
        return (
            f"{one_line(error)}; see whether the store of files behind the server runs, and lets the server in "
            "(its --artifacts-destination)"
        )
    return (
        "it is not there; if mlflow.db was moved or copied, put its folder mlruns beside it, "
        "otherwise delete mlflow.db and run `make registry`"
    )


def _remedy(uri: str) -> str:
    if uri.startswith("http"):
        return (
            "is its server running, and the database behind it? Start it, or unset MLFLOW_TRACKING_URI to use mlflow.db"
        )
    if uri.startswith("sqlite:"):
        return "if the file is damaged, move it away: `make registry` rebuilds it from the cached results"
    return "use a server's http address or sqlite:///FILE"


def _migrate(uri: str) -> None:
    """Bring the database of an earlier mlflow to this one's schema; mlflow itself creates a missing one.

    mlflow retries for a minute on a file that is no database, so that is found out here.
    """
    with closing(sqlite3.connect(_database(uri))) as connection:
        connection.execute("PRAGMA schema_version")
    engine = database.create_sqlalchemy_engine_with_retry(uri)
    if database._get_schema_version(engine) not in {None, _newest()}:
        database._upgrade_db(engine)
    engine.dispose()


@cache
def _newest() -> str:
    """The schema of this mlflow, read once: alembic imports each of its 68 steps for it."""
    return str(database._get_latest_schema_revision())


def _database(uri: str) -> Path:
    """The file of a sqlite store."""
    return Path(uri.removeprefix("sqlite:///"))


def _follow(path: Path) -> None:
    """Let the store's files be found where they lie now, after its folder was moved or copied.

    mlflow stores absolute locations. Where the folder of an experiment lies beside the database and
    its stored location is elsewhere, that place is put in the place of the old one.
    """
    folder = path.resolve().parent / FILES
    with closing(sqlite3.connect(path)) as connection, connection:
        tables = {row[0] for row in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if "experiments" not in tables:
            return
        for (old,) in connection.execute("SELECT artifact_location FROM experiments").fetchall():
            parent, _, case = str(old).rpartition("/")
            here = folder / url2pathname(case)
            new = here.as_uri() if old.startswith("file:") else str(folder / case)
            if not parent.endswith("/" + FILES) or old == new or not here.is_dir():
                continue
            for table, column in LOCATIONS:
                if table in tables:
                    connection.execute(
                        f"UPDATE {table} SET {column} = ? || substr({column}, ?) "
                        f"WHERE {column} = ? OR substr({column}, 1, ?) = ?",
                        (new, len(old) + 1, old, len(old) + 1, old + "/"),
                    )


def experiment_id(client: MlflowClient, case: str) -> str:
    """The experiment named after the case; its artifacts lie in mlruns/<case> beside the store where that is a file.

    An experiment that somebody deleted in the UI is brought back: its name cannot be used again.
    """
    experiment = client.get_experiment_by_name(case)
    if experiment is None:
        uri = store_uri()
        local = (_database(uri).resolve().parent / FILES / case).as_uri() if uri.startswith("sqlite:") else None
        return str(client.create_experiment(case, local, {"mlflow.experimentKind": "custom_model_development"}))
    if experiment.lifecycle_stage == "deleted":
        client.restore_experiment(experiment.experiment_id)
    return str(experiment.experiment_id)


def hide_default(client: MlflowClient) -> None:
    """Take mlflow's own empty experiment off the list of cases."""
    default = client.get_experiment_by_name("Default")
    active = default is not None and default.experiment_id == "0" and default.lifecycle_stage == "active"
    if active and not client.search_runs(["0"], max_results=1):
        client.delete_experiment("0")
