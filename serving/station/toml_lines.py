"""Lines of a loop.toml for a law that operators steer while it runs: its values, its MVs, its bad readings."""

from __future__ import annotations

from loopwright.serving.bridging import BRIDGE_PERIODS
from loopwright.serving.manifest import Manifest
from loopwright.serving.mvs.local_mvs import ELSEWHERE_PERIODS
from loopwright.serving.operating import allowed
from loopwright.serving.words import plain


def operate_lines(m: Manifest) -> list[str]:
    """Nodes and values of ``operate``, and of the MVs that the plant has itself."""
    if not m.operate:
        return []
    return [
        "",
        "# [nodes.operate]  # values that the plant's own operator sets: ranges, uses, limits",
        *(f"# {text_of(e.name)} = {text_of(node_id('Operate', e.name))}  # {plain(allowed(e))}" for e in m.operate),
        *_local_lines(m),
        "",
        "# [operate]  # values that the loop begins with, in place of the law's own",
        f"# {text_of(m.operate[0].name)} = {m.operate[0].default:g}",
    ]


def _local_lines(m: Manifest) -> list[str]:
    names = [e.signal for e in m.operate if e.group == "mv" and e.what == "use"]
    if not names:
        return []
    return [
        "",
        "# [nodes.local]  # where the plant says that it has an MV itself: the law then goes on without it",
        *(
            f'# {key_of(n)} = {{ node = {text_of(node_id("Local", n))}, local = ["MAN", 1] }}  # or remote = [...]'
            for n in names
        ),
        "",
        "# [local]",
        f"# after_s = {ELSEWHERE_PERIODS * m.period_s:g}  # [s] elsewhere than commanded: the plant has it; 0: never",
    ]


def fresh_lines(m: Manifest) -> list[str]:
    """The settings of readings that are bad alone."""
    if "fresh" not in m.inputs:
        return []
    return [
        "",
        "[fresh]  # a PV whose reading alone is bad",
        f"bridge_s = {BRIDGE_PERIODS * m.period_s:g}  # [s] for which the law predicts it; then it is left out",
        f"# critical = [{text_of(m.pv[0].name)}]  # without these the loop holds then",
        "",
        "# [nodes.analysers]  # PVs whose number stands between two results: the longest time [s] without a new one",
        f"# {key_of(m.pv[-1].name)} = {100 * m.period_s:g}",
        "# or, of a server that stamps a value when it is made, so that two equal results are two:",
        f'# {key_of(m.pv[-1].name)} = {{ longest_s = {100 * m.period_s:g}, new = "source_time" }}',
    ]


def node_id(group: str, name: str) -> str:
    """A node id as a simulated plant has it."""
    return f"nsu=urn:loopwright:plant;s={group}.{name}"


def key_of(name: str) -> str:
    """A name as a key of TOML."""
    bare = name.replace("_", "").replace("-", "")
    return name if bare.isascii() and bare.isalnum() else text_of(name)


def text_of(value: str) -> str:
    """A text of TOML: a quote, a backslash or a line break in it ends neither the text nor the line."""
    escaped = value.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in escaped) + '"'
