"""The registry of controllers: serve it, list it, promote, fetch and publish."""

from __future__ import annotations

import argparse
import os
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from urllib.parse import quote

from loopwright.pipeline.errors import TrackingError
from loopwright.pipeline.tracking.registry import CHAMPION, fetch, promote, registered, versions
from loopwright.pipeline.tracking.runs import publish
from loopwright.pipeline.tracking.signing import trusted, words
from loopwright.pipeline.tracking.store import store, store_uri
from loopwright.serving.words import plain

HOST = "127.0.0.1"
CHAMPIONS = "tags.standing LIKE 'champion%'"
"""MLflow's search for the registered models that are champion of their case."""


def _list(args: argparse.Namespace) -> None:
    with store() as client:
        models = registered(client)
        for model in models:
            for version in versions(client, model.name):
                aliases = " ".join(f"@{a}" for a in version.aliases)
                score = version.tags.get("gate_score", "-")
                over = version.tags.get("gate_relative_to", "")  # nothing: the NMPC, as for most cases
                signer = words(version.tags)
                row = f"{model.name:40} {version.version:>4}  gate {f'{score} {over}':10} {aliases}"
                # Whoever can write the store can write its tags.
                print(plain(f"{row:70}  signed by {signer}" if signer else row))
        if not models:
            print(
                "the registry is empty: `loopwright registry publish` fills it with what runs have made here, and "
                "`loopwright run` of all that params.yaml lists ends with it; a clone holds none until its first run"
            )


def _promote(args: argparse.Namespace) -> None:
    with store() as client:
        print(plain(promote(client, args.name, args.version, args.alias)))


def _fetch(args: argparse.Namespace) -> None:
    with store() as client:
        files, signer = fetch(client, args.controller, args.folder, trusted(args.key))
    for path in files:
        print(plain(str(path)))
    print(plain(signer), file=sys.stderr)


def _serve(args: argparse.Namespace) -> None:
    uri = store_uri()
    if uri.startswith("http"):
        print(f"the registry is served already: {uri}/#/models")
        return
    if not 0 < args.port < 65_536:
        raise TrackingError(f"port {args.port} does not exist; give one from 1 to 65535 with --port")
    with store(), socket.socket() as probe:
        if probe.connect_ex((HOST, args.port)) == 0:
            raise TrackingError(f"port {args.port} of {HOST} is taken; give another one with --port")
    page = f"http://{HOST}:{args.port}"
    print(f"champions:       {page}/#/models?searchInput={quote(CHAMPIONS)}")
    print(f"all controllers: {page}/#/models (the sidebar hides it)")
    print(f"runs by case:    {page}/#/experiments\nCtrl-C ends", flush=True)
    # mlflow's server would otherwise run jobs that its users submit
    # MLflow and the processes that it starts take no module from the folder in which somebody stands.
    environment = {**os.environ, "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false", "PYTHONSAFEPATH": "1"}
    options = ["--host", HOST, "--port", str(args.port), "--backend-store-uri", uri, "--workers", "1"]
    os.execve(sys.executable, [sys.executable, "-P", "-m", "mlflow", "server", *options], environment)


def options(parser: argparse.ArgumentParser) -> None:
    """Add the registry's own commands and their arguments."""
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=type(parser))

    def command(name: str, action: Callable[[argparse.Namespace], object], words: str) -> argparse.ArgumentParser:
        one = commands.add_parser(name, help=words)
        one.set_defaults(action=action)
        return one

    publishing = "write the cached results that the store lacks; LOOPWRIGHT_SIGNING_KEY, if set, signs the controllers"
    command("publish", lambda _: publish(Path.cwd()), publishing)
    command("list", _list, "controllers, versions, gate scores and aliases; the champion of each case first")
    one = command("promote", _promote, "make a version the champion of its case, or move another alias")
    one.add_argument("name", help="registered controller: CASE-CONTROLLER")
    one.add_argument("version", help="its version, a number")
    one.add_argument("--alias", default=CHAMPION, help="default: %(default)s")
    one = command("fetch", _fetch, "write a controller, its manifest and its signature into a folder")
    names = "CASE (its champion), CASE-CONTROLLER (its best version), CASE-CONTROLLER@ALIAS or CASE-CONTROLLER/VERSION"
    one.add_argument("controller", help=names)
    one.add_argument("folder", type=Path, help="where they go")
    known = "write nothing unless one of these public keys signed it (or those of LOOPWRIGHT_TRUSTED)"
    one.add_argument("--key", metavar="PUBLIC", type=Path, nargs="+", help=known)
    one = command("serve", _serve, "open MLflow's UI on this machine only, its job execution off")
    one.add_argument("--port", type=int, default=5000, help="default: %(default)s")


def run(options: argparse.Namespace) -> None:
    """Run the registry's command."""
    options.action(options)
