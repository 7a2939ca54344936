"""Commands and their options, from the parsers themselves."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Sequence

from loopwright.pipeline.commands import COMMANDS, OneLineParser, loaded
from manual.markdown import code, table

Actions = argparse._SubParsersAction


def parser_of(name: str) -> argparse.ArgumentParser:
    """The parser of one command, as ``loopwright NAME`` makes it."""
    parser = OneLineParser(prog=f"loopwright {name}", description=COMMANDS[name])
    before = os.environ.get("LOGNAME")
    os.environ["LOGNAME"] = "you"  # a default that is the user's name
    try:
        loaded(name).options(parser)
    finally:
        if before is None:
            del os.environ["LOGNAME"]
        else:
            os.environ["LOGNAME"] = before
    return parser


def parsers() -> Iterator[tuple[argparse.ArgumentParser, str]]:
    """Each command's parser with its words, its subcommands' after it."""
    for name, words in COMMANDS.items():
        parser = parser_of(name)
        yield parser, words
        yield from _below(parser)


def _below(parser: argparse.ArgumentParser) -> Iterator[tuple[argparse.ArgumentParser, str]]:
    for action in parser._actions:
        if isinstance(action, Actions):
            said = {a.dest: a.help or "" for a in action._choices_actions}
            for name, sub in action.choices.items():
                yield sub, said.get(name, "")
                yield from _below(sub)


def arguments(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    """The arguments that the command takes, without ``--help`` and the list of its subcommands."""
    return [a for a in parser._actions if not isinstance(a, (argparse._HelpAction, Actions))]


def spelled(action: argparse.Action) -> str:
    """An argument as it is written on the command line."""
    metavar = action.metavar if isinstance(action.metavar, str) else action.dest.upper()
    shown = metavar if action.nargs != 0 else ""
    if not action.option_strings:
        return f"[{shown}]" if action.nargs in {"?", "*"} else shown
    return ", ".join(f"{o} {shown}".strip() for o in action.option_strings)


def commands() -> str:
    """Every command: its words, its arguments."""
    done = []
    for parser, words in parsers():
        rows: Sequence[tuple[str, str]] = [(code(spelled(a)), _words(parser, a)) for a in arguments(parser)]
        level = "##" if parser.prog.count(" ") == 1 else "###"
        done.append(f"{level} {code(parser.prog)}\n\n{words[:1].upper()}{words[1:]}.")
        if rows:
            done.append(table(["argument", "meaning"], rows))
    return "\n\n".join(done)


def _words(parser: argparse.ArgumentParser, action: argparse.Action) -> str:
    text = (action.help or "") % {**vars(action), "prog": parser.prog}
    return text.replace("<", "&lt;").replace("*", "\\*").replace("_", "\\_").replace("[", "\\[")
