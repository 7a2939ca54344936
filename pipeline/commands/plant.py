"""``loopwright plant serve``: a simulated plant behind a real OPC UA server, to try a loop on."""

from __future__ import annotations

import argparse
import asyncio
import logging
import sys
from pathlib import Path

from loopwright.pipeline.cases import CASES, all_cases
from loopwright.pipeline.cases.own_model import to_train
from loopwright.pipeline.commands.arguments import positive, whole
from loopwright.pipeline.config.params import choose
from loopwright.pipeline.errors import PipelineError, PlantError
from loopwright.pipeline.evaluation.case import Array, Case
from loopwright.pipeline.evaluation.model_evidence import IDENTIFIED


def options(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    commands = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    serve = commands.add_parser("serve", help="serve the plant of a case until Ctrl-C")
    add = serve.add_argument
    add("case", metavar="CASE", help=f"{', '.join(sorted(CASES))}, or a plant of your own: its identified model")
    add("--listen", metavar="HOST:PORT", default="127.0.0.1:4840", help="where to listen (127.0.0.1:4840)")
    add("--speed", metavar="X", type=positive(), default=1.0, help="times real time (1)")
    add("--types", choices=["LREAL", "REAL"], default="LREAL", help="of the nodes: 64 bits or 32 (LREAL)")
    add("--noise", action="store_true", help="add the case's measurement noise")
    add("--seed", metavar="N", type=whole(0), default=0, help="of the noise (0)")
    add("--folder", metavar="FOLDER", type=Path, default=Path("plant-server"),
        help="of its certificate (plant-server)")  # fmt: skip
    add("--only-trusted", action="store_true",
        help="refuse clients without a certificate in FOLDER/trusted, and connections in the clear")  # fmt: skip
    add("--log", metavar="FILE", type=Path, help="write there what the actuator gets, a line of JSON each period")
    add("--periods", metavar="N", type=whole(1), help="stop after so many")
    fault = commands.add_parser("fault", help="spoil a signal of a served plant, or mend it")
    fault.add_argument("tag", metavar="TAG", help="PV.C_A, MV.T_j, RB.T_j, DV.F, ...; Control.Watchdog (frozen)")
    fault.add_argument("kind", metavar="KIND", choices=["ok", *FAULTS[1:]], help=", ".join(["ok", *FAULTS[1:]]))
    fault.add_argument("--endpoint", default="opc.tcp://127.0.0.1:4840", help="the served plant (%(default)s)")


def start_of(case: Case) -> tuple[Array, Array]:
    """State (n_x,) and MVs (n_mv,) that a case begins at: those of its first test, or the rest of an own plant.

    PlantError where an own plant has no model yet. A stand-in for an own plant is named on standard error.
    """
    if not case.on_models:
        test = next(iter(case.scenarios().values()))[0]
        return test.x0, test.mv0
    if not case.ready:
        raise PlantError(f"{case.name} has no model to serve yet, or one of an earlier record; {to_train(case.name)}")
    if case.stand_in == IDENTIFIED:
        print(
            f"{case.name}: this is the model that was identified from the record, the one that its controllers were "
            "designed on, and not the plant; what the model does not know, no loop on it shows",
            file=sys.stderr,
            flush=True,
        )
    return case.plant.start


def run(options: argparse.Namespace) -> None:
    """Serve the plant until Ctrl-C, or spoil a signal of one that is served."""
    from loopwright.pipeline.simulation.opcua_server import PlantServer, spoil

    logging.getLogger("asyncua").setLevel(logging.CRITICAL)  # what went wrong is said below, in a line
    if options.action == "fault":
        asyncio.run(spoil(options.endpoint, options.tag, "" if options.kind == "ok" else options.kind))
        print(f"{options.tag}: {options.kind}")
        return
    case = choose(all_cases(), options.case, "case")
    x, mv = start_of(case)
    server = PlantServer(
        plant=case.plant,
        endpoint=f"opc.tcp://{options.listen}",
        x=x.copy(),
        mv=mv.copy(),
        noise_std=case.noise_std if options.noise else None,
        seed=options.seed,
        speed=options.speed,
        types=options.types,
        folder=options.folder,
        trust_all=not options.only_trusted,
        log=options.log,
        tell=lambda line: print(line, flush=True),
    )
    try:
        asyncio.run(server.run(options.periods))
    except OSError as error:
        raise PipelineError(f"nothing can listen at {options.listen}: {error.strerror or error}") from None
    except KeyboardInterrupt:
        print("plant: ended", file=sys.stderr)


FAULTS = ("", "bad", "uncertain", "frozen", "text", "deleted", "int", "nan")  # "": nothing
