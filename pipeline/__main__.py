"""``loopwright``: the one command; ``loopwright.pipeline.commands`` has its commands."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

from loopwright.pipeline.commands import COMMANDS, OneLineParser, loaded
from loopwright.pipeline.commands.extras import advice
from loopwright.pipeline.engine.command import FAILURES, reason
from loopwright.pipeline.errors import nearest
from loopwright.serving.arguments import write_any_text
from loopwright.serving.version import __version__

EXAMPLES = """examples:
  loopwright run                                   the whole pipeline
  loopwright run ph_neutralization                 one case
  loopwright results                               every controller in one table
  loopwright simulate artifacts/thiosulfate_cstr/forward_dob.onnx --sp 0.5 --sp 0.9@60
  loopwright laws pid                              a law's parameters, their units and defaults"""
INTERRUPTED = 130  # as a shell counts Ctrl-C


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command: 0 if it went well, 2 after one line on standard error where it could not."""
    # No telemetry, whichever library a command loads.
    os.environ.update(MLFLOW_DISABLE_TELEMETRY="true", DVC_NO_ANALYTICS="1", DO_NOT_TRACK="1")
    write_any_text()
    words = list(sys.argv[1:] if arguments is None else arguments)
    name = words[0] if words else "--help"
    if name in {"-h", "--help"}:
        try:
            print(_help(), flush=True)
        except BrokenPipeError:  # `| head`: nobody reads on
            sys.stderr.close()
        return 0
    if name == "--version":
        print(f"loopwright {__version__}")
        return 0
    if name not in COMMANDS:
        print(f"loopwright: unknown command {name!r}{nearest(name, COMMANDS)}", file=sys.stderr)
        return 2
    try:
        command = loaded(name)
        parser = OneLineParser(prog=f"loopwright {name}", description=COMMANDS[name])
        command.options(parser)
        options = parser.parse_args(words[1:])
        status: int | None = command.run(options)
    except ModuleNotFoundError as error:  # installed for embedding, or for the plant, alone
        missing = advice(error.name or "")
        if missing is None:
            raise
        print(f"loopwright {name}: {missing}", file=sys.stderr)
        return 2
    except FAILURES as error:
        if isinstance(error, BrokenPipeError):  # `| head`: nobody reads on
            sys.stderr.close()
            return 0
        print(f"loopwright {name}: {reason(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return INTERRUPTED
    return status or 0


def _help() -> str:
    width = max(map(len, COMMANDS))
    rows = [f"  {name:{width}}  {words}" for name, words in COMMANDS.items()]
    head = ("usage: loopwright COMMAND [...]", "", "Neural process controllers from plant data.", "", "commands:")
    last = "`loopwright COMMAND --help` lists what a command takes, `loopwright --version` prints the version."
    return "\n".join([*head, *rows, "", EXAMPLES, "", last])


if __name__ == "__main__":
    sys.exit(main())
