"""The certificate in a controller's manifest: of plants like these at most so many fail, and who may believe it.

A certificate is made by ``loopwright certify`` and stands in the evidence under ``certificate``. It holds numbers and
names alone; the sentences are made here. It belongs to one law: ``Certificate.law`` is the digest of the graph and
of the manifest without its evidence, and of another law it says nothing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from loopwright.serving.errors import ArtifactError
from loopwright.serving.fields import parse
from loopwright.serving.manifest import Manifest

CERTIFICATE = "certificate"  # its place in the evidence
LISTED = 100  # failed loops that a manifest lists at most
SMALL_SHARE = 0.01  # a test of fewer loops than show at most so many failures, where none fails, is a small one
MOST_LOOPS = 10_000_000  # of a certificate
ROUNDED = 1e-6  # by which a probability may be off in its last digits, as a share of it
SHOWN_NAMES = 6  # parameters, failed loops or tests that a sentence names


@dataclass(frozen=True, slots=True)
class CertifiedFamily:
    """The plants of a certificate, and what else of a loop was drawn.

    ``parameters``: name -> lowest and highest value of all plants; ``plants`` is the number of plants that these belong
    to: those that the tests run on, of a record its models. ``spread``: share of a value by which a parameter without a
    stated range differs at most. ``loads`` and ``noise`` are the lowest and highest share of those of the tests,
    ``late`` the share of the loops with one more sample of dead time, ``faulty`` that of those with a fault of an
    actuator, one of ``faults``. ``held_out`` are the seeds of the tests' set points, ``without`` what was not drawn, in
    words.
    """

    case: str
    sha256: str
    plants: int
    tests: tuple[str, ...]
    held_out: tuple[int, ...]
    parameters: Mapping[str, tuple[float, float]]
    spread: float
    loads: tuple[float, float]
    noise: tuple[float, float]
    late: float
    faulty: float
    faults: tuple[str, ...]
    without: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready values."""
        return _entries(self)

    @property
    def words(self) -> str:
        """The plants, tests, loads, noise and faults that were drawn, in one line."""
        names = _some([f"{name} {low:.4g} to {high:.4g}" for name, (low, high) in self.parameters.items()])
        on = f"the {self.plants} plants of its tests" if self.plants > 1 else "its plant"
        said = [on, _some(list(self.tests), "test")]
        said += [f"with {names}"] if self.parameters else []
        said += [f"loads {_span(self.loads)} those of the tests", f"noise {_span(self.noise)} the usual"]
        said += [f"one more sample of dead time in {_percent(self.late)}"]
        if self.faulty:
            said += [f"an actuator's fault in {_percent(self.faulty)} ({', '.join(self.faults)})"]
        return "; ".join(said)


@dataclass(frozen=True, slots=True)
class Certificate:
    """``failures`` of ``loops`` closed loops failed, so at most ``at_most`` of the family do, with ``confidence``.

    ``law`` is the law's digest, ``plan`` that of what was fixed before the first loop ran, from which ``seed`` follows.
    ``fails_if`` names the failures, ``limits`` figures above which a loop fails too; ``failed`` are the numbers of the
    failed loops, the first ``LISTED`` of them, each with how it failed. ``stepped_by`` computed the steps of the law.
    """

    law: str
    plan: str
    seed: int
    loops: int
    failures: int
    confidence: float
    at_most: float
    fails_if: tuple[str, ...]
    family: CertifiedFamily
    limits: Mapping[str, float] = field(default_factory=dict)
    failed: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    stepped_by: str = ""

    def __post_init__(self) -> None:
        if not (1 <= self.loops <= MOST_LOOPS and 0 <= self.failures <= self.loops):
            raise ValueError(f"{self.failures} of {self.loops} loops failed, which cannot be")
        if not (0 < self.confidence < 1 and 0 < self.at_most <= 1 and self.fails_if):
            raise ValueError("confidence and at_most must be shares, and fails_if must name a failure")
        left = (1 - self.confidence) * (1 + ROUNDED)
        if self.failures < self.loops and failures_probability(self.failures, self.loops, self.at_most) > left:
            raise ValueError(
                f"{self.failures} failures of {self.loops} loops do not show that at most "
                f"{_percent(self.at_most)} fail with {_percent(self.confidence)} confidence"
            )

    @property
    def small(self) -> bool:
        """Whether so few loops cannot show a share of ``SMALL_SHARE``, even where none fails."""
        return (1 - SMALL_SHARE) ** self.loops > 1 - self.confidence

    @property
    def sentence(self) -> str:
        """The certificate in one sentence: ``of plants like these at most 1 % fail, ...``."""
        enough = loops_without_failure(SMALL_SHARE, self.confidence)
        few = f", a small number: {enough} can show 1 %" if self.small else ""
        return (
            f"of plants like these at most {_percent_up(self.at_most)} fail, with {100 * self.confidence:.6g} % "
            f"confidence ({self.failures} of {self.loops} closed loops failed{few})"
        )

    @property
    def failure_words(self) -> str:
        """The failures that count, in words."""
        limits = [f"has {name} above {value:.6g}" for name, value in self.limits.items()]
        return f"a loop that {_either([*self.fails_if, *limits])}"

    @property
    def grounds(self) -> tuple[str, ...]:
        """The grounds of the sentence, a line each: what a failure is, what was drawn, and what was not."""
        return (
            f"a failure: {self.failure_words}",
            f"the family: {self.family.words}",
            f"not in the family: {'; '.join(self.family.without) or 'not said'}",
        )

    @property
    def lines(self) -> tuple[str, ...]:
        """The sentence, what it rests on, and the first failed loops, a line each."""
        if not self.failed:
            return (self.sentence, *self.grounds)
        rest = self.failures - min(len(self.failed), SHOWN_NAMES)
        shown = [f"{loop} ({', '.join(how)})" for loop, how in list(self.failed.items())[:SHOWN_NAMES]]
        return (self.sentence, *self.grounds, f"failed loops: {', '.join(shown)}" + f", and {rest} more" * bool(rest))

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready values, as they stand in the evidence."""
        return {**_entries(self), "family": self.family.to_dict()}

    @classmethod
    def from_dict(cls, tree: Mapping[str, Any]) -> Certificate:
        """The certificate that ``to_dict`` wrote; ArtifactError where it is none."""
        return parse(cls, tree, "the certificate", ArtifactError)


@dataclass(frozen=True, slots=True)
class CertificateRead:
    """The certificate of a file, or why there is none to believe: ``wrong`` is empty where the file has none at all."""

    certificate: Certificate | None
    wrong: str = ""

    @property
    def lines(self) -> tuple[str, ...]:
        """For a person: the sentence and what it rests on, or what is wrong; nothing without a certificate."""
        return self.certificate.lines if self.certificate is not None else (self.wrong,) if self.wrong else ()


def certificate_of(manifest: Manifest, law: str) -> CertificateRead:
    """The certificate in a manifest whose law has the digest ``law`` (``Controller.law_sha256``)."""
    tree = manifest.evidence.get(CERTIFICATE)
    if tree is None:
        return CertificateRead(None)
    try:
        found = Certificate.from_dict(tree if isinstance(tree, Mapping) else {})
    except ArtifactError as error:
        return CertificateRead(None, f"it cannot be read: {error}")
    if found.law != law:
        return CertificateRead(
            None, f"it is that of another law ({found.law[:16]}...), and says nothing of this one: certify this file"
        )
    return CertificateRead(found)


def loops_without_failure(share: float, confidence: float) -> int:
    """The fewest loops of which none may fail so that at most ``share`` of all do: (1 - share)^n <= 1 - confidence."""
    return math.ceil(round(math.log(1 - confidence) / math.log(1 - share), 9))


def failures_probability(failures: int, loops: int, share: float) -> float:
    """Probability of at most so many failures among ``loops``, where a ``share`` of the family, below 1, fails.

        P = sum_(i <= failures) C(loops, i) share^i (1 - share)^(loops - i)

    Its terms are computed by their logarithms.
    """
    if share >= 1:
        return float(failures >= loops)
    whole, log, log_not = math.lgamma(loops + 1), math.log(share), math.log1p(-share)
    terms = (
        whole - math.lgamma(i + 1) - math.lgamma(loops - i + 1) + i * log + (loops - i) * log_not
        for i in range(failures + 1)
    )
    return min(math.fsum(map(math.exp, terms)), 1.0)


def _entries(of: Certificate | CertifiedFamily) -> dict[str, Any]:
    return {f.name: _json_ready(getattr(of, f.name)) for f in fields(of)}


def _json_ready(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _json_ready(of) for key, of in value.items()}
    return list(value) if isinstance(value, tuple) else value


# ------------------------------------------------------------------------------------------------------------- words
def _percent(share: float) -> str:
    return f"{100 * share:.3g} %"


def _percent_up(share: float) -> str:
    """A share in %, two digits of it, rounded up: a bound may not get smaller."""
    percent = 100 * share
    step = 10.0 ** (math.floor(math.log10(percent)) - 1)
    return f"{min(math.ceil(round(percent / step, 9)) * step, 100):.2g} %" if percent < 99.5 else "100 %"


def _span(ends: tuple[float, float]) -> str:
    return f"{ends[0]:.3g} to {ends[1]:.3g} times"


def _some(names: list[str], kind: str = "") -> str:
    """The first names, and how many more there are."""
    words = f"{kind}{'s' * (len(names) != 1)} " if kind else ""
    more = len(names) - SHOWN_NAMES
    return words + ", ".join(names[:SHOWN_NAMES]) + (f" and {more} more" if more > 0 else "")


def _either(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} or {names[-1]}"
