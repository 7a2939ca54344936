"""The text of params.yaml -> a tree of plain values; whatever spoils it is one clear error."""

from __future__ import annotations

from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml

from loopwright.pipeline.errors import ParamsError, nearest
from loopwright.serving.fields import MAX_DIGITS

SECTIONS = ("cases", "exports", "records", "models", "plants", "controllers")
OWN = "x-"  # a key that begins so is the user's, for values that aliases repeat
MOST_VALUES = 1_000_000  # aliases counted as often as they stand for something
MAX_PARAMS_DEPTH = 50  # lists and mappings within each other: a deeper file would exhaust the stack


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Takes no key twice in one mapping, and no integer that no computation could hold."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        """The mapping of a node; MarkedYAMLError for a key that stands there twice."""
        seen = set[str]()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
                if key.value in seen:
                    raise yaml.constructor.ConstructorError(
                        None, None, f"the key {key.value[:100]!r} stands twice in one mapping", key.start_mark
                    )
                seen.add(key.value)
        found: dict[Hashable, Any] = super().construct_mapping(node, deep)
        return found

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        """The integer of a node; MarkedYAMLError for one that is too long."""
        if len(node.value) > MAX_DIGITS:
            words = f"an integer has {len(node.value)} digits; it may have {MAX_DIGITS}"
            raise yaml.constructor.ConstructorError(None, None, words, node.start_mark)
        found: int = super().construct_yaml_int(node)
        return found


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)


def tree_of(text: str, path: Path) -> dict[str, Any]:
    """The mapping that a text of YAML holds, its sections known by name; an empty text holds none.

    Raises ParamsError, with the line where YAML names it.
    """
    try:
        _require_shallow(text, path)
        tree = yaml.load(text, Loader=_Loader)
    except yaml.constructor.ConstructorError as error:
        raise ParamsError(f"{path} holds a value that cannot be read: {' '.join(str(error).split())}") from None
    except yaml.YAMLError as error:
        raise ParamsError(f"{path} is not YAML in UTF-8: {' '.join(str(error).split())}") from None
    except (ValueError, LookupError, AttributeError, OverflowError, TypeError) as error:  # of a tag, as !!bool "abc"
        raise ParamsError(f"{path} holds a value that cannot be read: {error!r:.200}") from None
    if tree is None:
        tree = {}
    if not isinstance(tree, dict):
        raise ParamsError(f"{path} holds no mapping; it needs the sections cases, records, models, controllers")
    _values(tree, path, {})
    for key in tree:
        if not isinstance(key, str) or not (key in SECTIONS or key.startswith(OWN)):
            raise ParamsError(
                f"{path}: unknown section {key!r}{nearest(key, SECTIONS)}; "
                "a key of your own, for aliases, begins with x-"
            )
        for name in tree[key] if key in SECTIONS and isinstance(tree[key], dict) else ():
            if not isinstance(name, str):
                raise ParamsError(f"{path}: {key} has the name {name!r}, which YAML reads as no text; put it in quotes")
    return tree


def _require_shallow(text: str, path: Path) -> None:
    """ParamsError for lists or mappings that are nested too deep: composing them would end the process."""
    depth = 0
    for event in yaml.parse(text, Loader=_Loader):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_PARAMS_DEPTH:
            raise ParamsError(f"{path} has lists or mappings nested more than {MAX_PARAMS_DEPTH} deep")


def _values(value: object, path: Path, known: dict[int, int]) -> int:
    """How many values there are when each alias is written out. ParamsError beyond ``MOST_VALUES``."""
    if not isinstance(value, dict | list):
        return 1
    if known.get(id(value)) == 0:
        raise ParamsError(f"{path} has an alias inside of what it stands for")
    if id(value) not in known:
        known[id(value)] = 0
        inner = value.values() if isinstance(value, dict) else value
        known[id(value)] = 1 + sum(_values(one, path, known) for one in inner)
    if known[id(value)] > MOST_VALUES:
        raise ParamsError(f"{path} holds more than {MOST_VALUES} values, its aliases written out")
    return known[id(value)]
