"""A command line as people write it: options before or after the files, on a terminal of any encoding."""

from __future__ import annotations

import argparse
import io
import re
import sys
from collections.abc import Iterable, Sequence
from typing import Any

NUMBER = re.compile(r"-(\d+|\d*\.\d+)$")


class Parser(argparse.ArgumentParser):
    """Takes options between and before the positional words, where argparse would lose or swallow these.

    An option of several values leaves those words at its end that the command itself lacks:
    ``verify --key anna.pub pid.onnx`` is ``verify pid.onnx --key anna.pub``.
    """

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse, the options first."""
        words = list(sys.argv[1:] if args is None else args)
        return super().parse_known_args(self._options_first(words), namespace)

    def _options_first(self, words: list[str]) -> list[str]:
        """The words with the positional ones at the end; as they are where argparse has to say what is wrong."""
        own = self._get_positional_actions()
        if any(isinstance(action, argparse._SubParsersAction) for action in own):
            return words  # the command that it names does so with its own
        groups: list[list[str]] = []  # an option and its values
        places, i = list[str](), 0
        while i < len(words):
            word = words[i]
            i += 1
            if word == "--":
                places += words[i:]
                break
            if not word.startswith("-") or word == "-" or NUMBER.match(word):
                places.append(word)
                continue
            action = self._option(word)
            if action is None or action.nargs not in (None, 0, "+"):
                return words
            group, most = [word], 0 if "=" in word else {None: 1, 0: 0, "+": len(words)}[action.nargs]
            while len(group) <= most and i < len(words) and (not words[i].startswith("-") or NUMBER.match(words[i])):
                group.append(words[i])
                i += 1
            if action.nargs is None and most and len(group) == 1:
                return words
            if action.nargs == "+" and most:
                missing = sum(a.nargs in (None, "+") for a in own) - len(places) - _plain(words[i:], self)
                if 0 < missing < len(group) - 1:
                    places += group[-missing:]
                    del group[-missing:]
            groups.append(group)
        options = [word for group in groups for word in group]
        return [*options, "--", *places] if places else options

    def _option(self, word: str) -> argparse.Action | None:
        """The option that a word names, also by the beginning of its name."""
        name, known = word.partition("=")[0], self._option_string_actions
        if name in known:
            return known[name]
        found = {id(action): action for text, action in known.items() if text.startswith(name)}
        return next(iter(found.values())) if len(found) == 1 and name.startswith("--") else None


def _plain(words: Sequence[str], parser: Parser) -> int:
    """How many positional words follow for certain: those behind another option and its value."""
    count, i = 0, 0
    while i < len(words):
        action = parser._option(words[i]) if words[i].startswith("-") and words[i] != "--" else None
        if action is not None and action.nargs == "+":
            return count
        i += 2 if action is not None and action.nargs is None and "=" not in words[i] else 1
        count += action is None and not words[i - 1].startswith("-")
    return count


def write_any_text(streams: Iterable[Any] = ()) -> None:
    """Let standard output and error spell out what their encoding lacks, such as a degree sign in ASCII."""
    for stream in streams or (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="backslashreplace")
