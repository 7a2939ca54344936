"""Controller FMUs in fmpy: the bits of the conformance kit, faults, the time grid, states, several instances."""

from __future__ import annotations

import copy
import importlib
import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from controller_fmus import MISSING, Array, PlainSteps, Unit, answers_of, controller_of, tools, unpacked
from kits import SHIPPED, name

from loopwright.pipeline.cases import PLANTS
from loopwright.pipeline.errors import HostError
from loopwright.pipeline.hosts.fmu.folder import (
    build_description,
    check,
    description,
    identifier_of,
    pack,
    problems,
    token_of,
    write_folder,
)
from loopwright.pipeline.hosts.fmu.law_sources import plain_answers
from loopwright.pipeline.hosts.fmu.variables import variables_of
from loopwright.pipeline.plants.fmu.instance import NAMES
from loopwright.serving import Controller
from loopwright.serving.conformance.steps import StepResult

if MISSING:
    pytest.skip(MISSING, allow_module_level=True)
fmpy = pytest.importorskip("fmpy")

pytest_plugins = ["small_laws", "operated_laws", "course_files"]
PID = "thiosulfate_cstr/pid"
# Laws with and without state, read-back and network; several MVs, one of set values.
# The law's part is the same C in both versions, so only some are played in both.
PLAYED = {
    PID: (2, 3), "thiosulfate_cstr/incad": (3,), "jacketed_batch_reactor/fuzzy_feedforward_observer": (2, 3),
    "ph_neutralization/predictive": (3,), "batch_reactor/recursive_pid": (2,), "reversible_cstr/model_reference": (3,),
    "henson_seborg_cstr/local_pid_network": (2,),
}  # fmt: skip


@pytest.fixture
def opened() -> Iterator[ExitStack]:
    """Closes instances at the end of a test."""
    with ExitStack() as stack:
        yield stack


def unit(stack: ExitStack, of: str = PID, fmi: int = 3, *, logging: bool = False) -> Unit:
    return stack.enter_context(closing(Unit(unpacked(of, fmi), logging=logging)))


def state_of(u: Unit, of: str) -> bytes:
    """The law's state, which stands last in a saved one."""
    n = controller_of(of).manifest.n_state
    return u.written()[-8 * n :] if n else b""


# ------------------------------------------------------------------ the same bits
def compared(controller: Controller, answers: list[StepResult], u: Unit) -> Counter[str]:
    """Play a kit's steps from its states; how many gave numbers ("") and how many were refused, and because of what."""
    n, seen = controller.manifest.n_state, Counter[str]()
    groups = [group for group in controller.manifest.inputs if group != "state"]

    def found() -> list[bytes]:
        state = u.written()[-8 * n :] if n else b""  # it stands last
        return [bytes(u.get("mv")), bytes(u.get("info")), state]

    for answer in answers:
        if answer.given.cold:
            u.reset()
            u.begin(**({"use_fresh": True} if "fresh" in groups else {}))
        if n:
            u.read(u.written()[: -8 * n] + answer.state.tobytes())
        before = found()
        u.set(**{group: answer.given.inputs[group] for group in groups})
        u.step(controller.manifest.period_s)
        step = answer.step
        assert u.fault == (step is None)
        assert found() == (before if step is None else [bytes(step.mv), bytes(step.info), bytes(step.state)])
        seen[answer.refused] += 1
    return seen


@pytest.mark.parametrize(("of", "fmi"), [(of, fmi) for of, versions in PLAYED.items() for fmi in versions])
def test_an_fmu_gives_the_bits_of_the_kit(of: str, fmi: int, opened: ExitStack) -> None:
    seen = compared(controller_of(of), answers_of(of), unit(opened, of, fmi))
    assert seen[""] > 300
    assert seen["input"] >= 6


@pytest.mark.parametrize("fmi", [2, 3])
def test_an_fmu_refuses_results_and_takes_measured_disturbances(
    fmi: int, disobedient_file: Path, tmp_path: Path
) -> None:
    """No shipped controller has measured disturbances or leaves its range; this one does both."""
    controller = Controller(disobedient_file)
    write_folder(controller, tmp_path, fmi, tools())
    assert problems(tmp_path) == []
    with closing(Unit(tmp_path, logging=True)) as u:
        seen = compared(controller, plain_answers(controller), u)
        assert u.names("dv")
        assert min(seen.values()) >= 15
        assert len(u.said) == seen["input"] + seen["output"]
        ends = ("%, which it may not have", "it may move by at most 30 a period")
    assert sum("the law gave valve = " in words and any(end in words for end in ends) for words in u.said) > 0


@pytest.fixture(scope="module", params=[2, 3])
def operated(
    request: pytest.FixtureRequest, operated_file: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Controller, Path]:
    """A controller that reads ``operate`` and ``fresh``, and the folder of its FMU."""
    controller, folder = Controller(operated_file), tmp_path_factory.mktemp("operated")
    write_folder(controller, folder, request.param, tools())
    assert problems(folder) == []
    return controller, folder


def test_an_fmu_takes_what_operators_change(operated: tuple[Controller, Path]) -> None:
    controller, folder = operated
    with closing(Unit(folder)) as u:
        assert [name.removeprefix("operate.") for name in u.names("operate")] == [
            e.name for e in controller.manifest.operate
        ]
        assert u.names("fresh") == ["fresh.y0", "fresh.y1"]
        seen = compared(controller, plain_answers(controller), u)
        assert seen[""] > 300
    variables = {v.name: v for v in fmpy.read_model_description(str(folder)).modelVariables}
    for e in controller.manifest.operate:
        v = variables[f"operate.{e.name}"]
        assert (float(v.min), float(v.max), float(v.start), v.unit or "") == (e.low, e.high, e.default, e.unit)
        assert (v.causality, v.variability) == ("parameter", "tunable")
        assert v.description


@pytest.mark.parametrize("fmi", [2, 3])
def test_an_fmu_takes_what_is_to_come(previewing: Controller, tmp_path: Path, fmi: int) -> None:
    write_folder(previewing, tmp_path, fmi, tools())
    assert problems(tmp_path) == []
    ahead = previewing.manifest.ahead
    assert ahead is not None
    with closing(Unit(tmp_path)) as u:
        wanted = [f"ahead.{s.group}.{s.signal}.{i}" for i in range(1, ahead.horizon + 1) for s in ahead.signals]
        assert u.names("ahead") == wanted
        seen = compared(previewing, plain_answers(previewing), u)
        assert seen[""] > 300
        u.reset()
        u.begin()
        u.set(ahead=np.full(ahead.size, 9.0))
        u.step(previewing.manifest.period_s)
        assert u.fault  # refused, and not clipped
    v = {v.name: v for v in fmpy.read_model_description(str(tmp_path)).modelVariables}["ahead.dv.d0.1"]
    assert (float(v.min), float(v.max), float(v.start), v.causality) == (-2.0, 2.0, 0.0, "input")


def test_without_a_value_an_fmu_has_the_defaults_and_all_is_fresh(operated: tuple[Controller, Path]) -> None:
    """A tool that writes 0 to each input without a connection blinds no law: use_fresh is false."""
    controller, folder = operated
    state, mv, law = controller.cold_state(), np.zeros(2), PlainSteps(controller)
    with closing(Unit(folder)) as u:
        u.begin()
        u.set(fresh=[0.0, 0.0])
        for k in range(20):
            pv = [0.3 * np.sin(k), 0.1 * k]
            mv, state, _ = law.step(sp=[0.5, 0], pv=pv, dv=[0.1], mv_applied=mv, state=state)
            u.set(sp=[0.5, 0], pv=pv, dv=[0.1])
            u.step(1.0)
            assert bytes(u.get("mv")) == bytes(mv)
            assert not u.fault


def as_number(u: Unit, name: str) -> None:
    """Set a Boolean variable as if it were a real one."""
    getattr(u.fmu, NAMES[u.fmi]["set"])([u.references[name]], [1.0])


def test_a_value_that_operators_may_not_set_is_refused_by_an_fmu(operated: tuple[Controller, Path]) -> None:
    with closing(Unit(operated[1], logging=True)) as u:
        for act, words in (
            (lambda: u.set(operate__u0__high=2.0), "operate: u0.high is 2; allowed is -1 to 1 V"),
            (lambda: u.set(operate__u0__use=0.5), "operate: u0.use is 0.5; allowed is 0 or 1"),
            (lambda: u.set(operate__y0__rank=np.nan), "operate: y0.rank is nan; allowed is 1 to 4"),
            (lambda: as_number(u, "use_fresh"), "there is no real variable"),
            (lambda: u.begin(operate__u0__low=0.5, operate__u0__high=0.2), "u0.low is 0.5, above u0.high = 0.2; "),
        ):
            with pytest.raises(Exception, match="failed"):
                act()
            assert words in u.said[-1]
        u.reset()
        u.begin(operate__u0__low=-0.1, operate__u0__high=0.2, use_fresh=True)
        for k in range(10):
            u.set(sp=[(-1.0) ** k, 1.0], pv=[0.1 * k, 0.0])
            u.step(1.0)
            assert -0.1 <= u.get("mv")[0] <= 0.2
        before = u.written()
        u.set(operate__u0__low=0.9)
        with pytest.raises(Exception, match="failed"):
            u.step(1.0)
        assert "u0.low is 0.9, above u0.high = 0.2" in u.said[-1]
        u.set(operate__u0__low=-0.1)
        assert u.written() == before
        assert not u.fault
        u.set(operate__u0__use=0.0, fresh=[1.0, 0.0])
        held = u.get("mv")[0]
        u.step(1.0)
        assert u.get("mv")[0] == held
        u.set(fresh=[1.0, 0.5])  # no flag: as an input that is not finite
        u.step(1.0)
        assert u.fault
        with pytest.raises(Exception, match="failed"):
            u.set(use_fresh=False)
        assert "use_fresh cannot be set after the initialization" in u.said[-1]


def test_a_saved_state_keeps_what_operators_have_changed(operated: tuple[Controller, Path]) -> None:
    with closing(Unit(operated[1], logging=True)) as u, closing(Unit(operated[1])) as other:
        u.begin(use_fresh=True)
        u.set(operate__u1__high=0.4, operate__speed=2.0, fresh=[0.0, 1.0], pv=[0.2, 0.3])
        u.step(1.0)
        content = u.written()
        other.read(content)
        other.now = u.now
        for each in (u, other):
            each.set(pv=[0.5, -0.2])
            each.step(1.0)
        assert u.written() == other.written()
        place = 72 + 8 * (7 + u.references["operate.u1.high"] - 3)
        assert np.frombuffer(content[place : place + 8])[0] == 0.4
        for wrong in (np.nan, 1.5):
            with pytest.raises(Exception, match="failed"):
                u.read(content[:place] + np.float64(wrong).tobytes() + content[place + 8 :])
            assert "the saved state has operate: u1.high is" in u.said[-1]


def test_the_gate_lets_no_fmu_of_another_controller_pass(tmp_path: Path) -> None:
    one, other = twins()
    pack(unpacked(other, 3), tmp_path / "other.fmu")
    played = tmp_path / "other.fmu", unpacked(other, 3)
    assert check(controller_of(other), *played, answers_of(other)) == len(answers_of(other))
    with pytest.raises(HostError, match="of the conformance kit"):
        check(controller_of(other), *played, answers_of(other, onnxruntime=True))
    with pytest.raises(HostError, match="in step 0 of the conformance kit"):
        check(controller_of(one), *played, answers_of(one))


def twins() -> tuple[str, str]:
    """Two different controllers with the same variables."""
    found: dict[tuple[str, ...], str] = {}
    for file in SHIPPED:
        of = f"{file.parent.name}/{file.stem}"
        key = tuple(row.name for row in variables_of(controller_of(of).manifest))
        if key in found:
            return found[key], of
        found[key] = of
    raise AssertionError("no two controllers have the same variables")


# ------------------------------------------------------------------ faults
@pytest.mark.parametrize("fmi", [2, 3])
def test_a_value_that_is_not_finite_is_a_fault_that_holds(fmi: int, opened: ExitStack) -> None:
    u, period = unit(opened, fmi=fmi, logging=True).begin(), controller_of(PID).manifest.period_s
    for value in (0.5, np.nan, np.inf, 0.6):
        before = (u.get("mv"), u.get("info"), state_of(u, PID))
        u.set(sp__C_A=value)
        u.step(period)
        after = (u.get("mv"), u.get("info"), state_of(u, PID))
        assert u.fault == (not np.isfinite(value))
        assert ([bytes(a) for a in before] == [bytes(a) for a in after]) == u.fault
    assert len(u.said) == 2
    assert u.said[0] == "the sample at 0.5 s is refused and the MV held: sp[0] is nan; no MV is computed from it"


def test_faults_are_told_with_logging_on_only(opened: ExitStack) -> None:
    u = unit(opened).begin()
    u.set(sp__C_A=np.nan)
    u.step(0.5)
    assert u.fault
    assert u.said == []


def test_a_call_that_is_not_allowed_says_why(opened: ExitStack) -> None:
    for fmi in (2, 3):
        u = unit(opened, fmi=fmi)
        for act, words in (
            (lambda u=u: u.step(0.5), "a step needs an initialization before it"),
            (lambda u=u: u.begin(mv_start=9e3), "mv_start.T_j = 9000 K is not allowed: its range is 0 to 500"),
            (lambda u=u: (u.reset(), u.begin(), u.set(mv=1.0)), "of mv, cannot be set because it is an output"),
            (lambda u=u: u.set(mv_start=250.0), "of mv_start, cannot be set after the initialization"),
            (lambda u=u: u.set(use_mv_applied=False), "use_mv_applied cannot be set after the initialization"),
            (lambda u=u: u.fmu.doStep(7.0, 0.5), "the step begins at 7 s, but the last one ended at 0 s"),
            (lambda u=u: u.fmu.doStep(0.0, np.nan), "a communication step of nan s from 0 s on is not allowed"),
            (lambda u=u: u.fmu.doStep(0.0, 1e300), "a communication step of 1e+300 s from 0 s on is not allowed"),
            (lambda u=u: u.fmu.doStep(0.0, -0.5), "a communication step of -0.5 s from 0 s on is not allowed"),
        ):
            with pytest.raises(Exception, match="failed"):
                act()
            assert words in u.said[-1]
        u.step(0.5)  # and the FMU goes on
        assert not u.fault


# ------------------------------------------------------------------ time
def chained(of: str, given: list[Array], applied: list[Array] | None = None) -> list[Array]:
    """The statements' MVs for PVs (n_pv,) a sample; without ``applied`` each MV is the next sample's read-back."""
    controller = controller_of(of)
    m, state, law = controller.manifest, controller.cold_state(), PlainSteps(controller)
    mv, found = np.array([s.middle for s in m.mv]), []
    for k, pv in enumerate(given):
        mv_applied = mv if applied is None else applied[k]
        mv, state, _ = law.step(
            sp=[s.middle for s in m.sp], pv=pv, dv=[s.middle for s in m.dv], mv_applied=mv_applied, state=state
        )
        found.append(mv)
    return found


def drawn(of: str, n: int, seed: int = 0) -> list[Array]:
    rng, pvs = np.random.default_rng(seed), controller_of(of).manifest.pv
    return [np.array([rng.uniform(s.low, s.high) for s in pvs]) for _ in range(n)]


@pytest.mark.parametrize("share", [0.1, 1 / 3, 0.7, 1.0, 2.5])
@pytest.mark.parametrize("start", [0.0, 1234.5])
def test_the_law_runs_on_its_own_grid_whatever_the_steps(share: float, start: float, opened: ExitStack) -> None:
    period, u = controller_of(PID).manifest.period_s, unit(opened, fmi=2).begin(start)
    given, samples, seen = drawn(PID, 120), [], []
    for k, pv in enumerate(given):
        u.set(pv=pv)
        u.step(share * period)
        first, end = (int(np.ceil(round(at * share, 9))) for at in (k, k + 1))
        samples += [pv] * (end - first)
        seen.append((len(samples), u.get("mv")))
    expected = chained(PID, samples)
    assert len(samples) == round(np.ceil(round(120 * share, 9)))
    assert all(bytes(mv) == bytes(expected[n - 1]) for n, mv in seen)


def test_rounding_of_times_neither_drops_nor_adds_a_sample(opened: ExitStack) -> None:
    """Ten steps of a tenth a period: their sum misses the grid by rounding, on either side."""
    period, u = controller_of(PID).manifest.period_s, unit(opened).begin(0.1)
    given = drawn(PID, 400)
    expected = chained(PID, given)
    for pv, mv in zip(given, expected, strict=True):
        u.set(pv=pv)
        for _ in range(10):
            u.step(period / 10)
            assert bytes(u.get("mv")) == bytes(mv)


# ------------------------------------------------------------------ the read-back, and the start
def test_the_read_back_is_the_last_mv_until_it_is_set(opened: ExitStack) -> None:
    given, period = drawn(PID, 20), controller_of(PID).manifest.period_s
    stuck = np.array([321.0])

    def ran(u: Unit, *, set_in_steps: bool) -> list[bytes]:
        found = []
        for pv in given:
            u.set(pv=pv, **({"mv_applied": stuck} if set_in_steps else {}))
            u.step(period)
            found.append(bytes(u.get("mv")))
        return found

    own, other = ([bytes(mv) for mv in chained(PID, given, a)] for a in (None, [stuck] * len(given)))
    assert own != other
    assert ran(unit(opened).begin(), set_in_steps=False) == own
    assert ran(unit(opened).begin(mv_applied=stuck), set_in_steps=False) == own  # a start value connects nothing
    assert ran(unit(opened).begin(), set_in_steps=True) == other
    assert ran(unit(opened).begin(use_mv_applied=False), set_in_steps=True) == own


@pytest.mark.parametrize("fmi", [2, 3])
def test_the_mv_before_the_first_sample_is_a_parameter(fmi: int, opened: ExitStack) -> None:
    u = unit(opened, fmi=fmi)
    assert u.get("mv").tolist() == [250.0]
    u.begin(mv_start=300.0)
    assert u.get("mv").tolist() == [300.0]
    u.set(sp__C_A=np.nan)
    u.step(0.5)
    assert u.get("mv").tolist() == [300.0]  # held by a fault of the first sample too
    u.reset()
    assert u.begin().get("mv").tolist() == [250.0]


# ------------------------------------------------------------------ states and instances
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("of", [PID, "thiosulfate_cstr/incad"])
def test_a_saved_state_goes_on_as_before(of: str, fmi: int, opened: ExitStack) -> None:
    given, period = drawn(of, 30), controller_of(of).manifest.period_s

    def ran(u: Unit, part: list[Array]) -> list[bytes]:
        found = []
        for pv in part:
            u.set(pv=pv)
            u.step(0.7 * period)
            found.append(bytes(u.get("mv")) + bytes(u.get("info")))
        return found

    u = unit(opened, of, fmi).begin()
    ran(u, given[:10])
    state, content, at = u.call("save"), u.written(), u.now
    after = ran(u, given[10:])
    u.call("restore", state)
    u.now = at
    assert ran(u, given[10:]) == after
    u.call("restore", state)  # once more, after it was used
    assert u.written() == content
    u.call("free", state)
    other = unit(opened, of, fmi)  # another process would do the same: bytes hold no addresses
    other.read(content)
    other.now = at
    assert ran(other, given[10:]) == after


@pytest.mark.parametrize("fmi", [2, 3])
def test_bytes_that_are_no_state_of_this_fmu_are_refused(fmi: int, opened: ExitStack) -> None:
    u = unit(opened, fmi=fmi).begin()
    u.step(0.5)
    content = u.written()
    foreign = unit(opened, "thiosulfate_cstr/incad", fmi).begin().written()
    wrong = [content[:-1], b"", foreign, b"x" + content[1:]]
    for place, value in ((0, 7.0), (1, np.inf), (2, np.nan), (3, -9e15)):  # phase, start, time, samples
        at = 72 + 8 * place
        wrong.append(content[:at] + np.float64(value).tobytes() + content[at + 8 :])
    for each in wrong:
        with pytest.raises(Exception, match="failed"):
            u.read(each)
        assert "state" in u.said[-1]
    u.read(content)
    assert u.written() == content


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_forged_state_is_refused_and_the_instance_goes_on(fmi: int, opened: ExitStack) -> None:
    """The MV beyond its range, or a number of the law that no step can give: nothing of it becomes an output."""
    of = "jacketed_batch_reactor/fuzzy_feedforward_observer"  # two MVs, one of set values
    m, u, other = controller_of(of).manifest, unit(opened, of, fmi).begin(), unit(opened, of, fmi)
    for pv in drawn(of, 5):
        u.set(pv=pv)
        u.step(m.period_s)
    content = u.written()
    # Behind 72 bytes of digest and count: 7 numbers of the FMU's own, then the groups, then the law's state.
    groups = [len(m.sp), len(m.pv), len(m.dv) if "dv" in m.inputs else 0, len(m.mv) if "mv_applied" in m.inputs else 0]
    start = 7 + sum(groups)
    mv, info = start + len(m.mv), start + 2 * len(m.mv)
    law = info + len(m.info)
    assert len(content) == 72 + 8 * (law + m.n_state)
    (allowed,) = [s for s in m.mv if s.values is not None]
    discrete = m.mv.index(allowed)
    wrong = [
        *((mv + i, v) for i, s in enumerate(m.mv) for v in (np.nan, s.high + 1.0, s.low - 1e-6)),
        (start, np.inf),
        (mv + discrete, allowed.values[0] / 3 + allowed.values[1] * 2 / 3),
        (info, np.nan),
        (law, np.nan),
        (law + m.n_state - 1, -np.inf),
        *((flag, v) for flag in (4, 5, 6) for v in (0.5, np.nan)),
    ]
    for place, value in wrong:
        at = 72 + 8 * place
        with pytest.raises(Exception, match="failed"):
            u.read(content[:at] + np.float64(value).tobytes() + content[at + 8 :])
        assert "the saved state has" in u.said[-1]
        assert u.written() == content
    other.read(content)
    other.now = u.now
    for pv in drawn(of, 5, seed=1):
        for each in (u, other):
            each.set(pv=pv)
            each.step(m.period_s)
        assert u.written() == other.written()


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_state_before_the_initialization_can_be_restored(fmi: int, opened: ExitStack) -> None:
    """Its MV is what the tool set, allowed or not; the end of the initialization checks it."""
    u = unit(opened, fmi=fmi)
    u.set(mv_start=9e3)
    content = u.written()
    u.set(mv_start=300.0)
    u.read(content)
    with pytest.raises(Exception, match="failed"):
        u.begin()
    assert "mv_start.T_j = 9000 K is not allowed" in u.said[-1]


@pytest.mark.parametrize("fmi", [2, 3])
def test_instances_do_not_disturb_each_other(fmi: int, opened: ExitStack) -> None:
    period, n = controller_of(PID).manifest.period_s, 40
    courses = [drawn(PID, n, seed) for seed in (1, 2)]
    units = [unit(opened, fmi=fmi).begin() for _ in courses]
    third = unit(opened, "ph_neutralization/predictive", fmi).begin()
    found: list[list[bytes]] = [[], []]
    for k in range(n):
        for u, course, into in zip(units, courses, found, strict=True):
            u.set(pv=course[k])
            u.step(period)
            into.append(bytes(u.get("mv")))
        third.set(pv=drawn("ph_neutralization/predictive", 1, k)[0])
        third.step(period)
        if k == n // 2:  # one more of the same FMU begins, faults and ends
            with closing(Unit(unpacked(PID, fmi))) as passing:
                passing.begin().set(sp=np.nan)
                passing.step(period)
                assert passing.fault
    assert found == [[bytes(mv) for mv in chained(PID, course)] for course in courses]
    assert found[0] != found[1]


# ------------------------------------------------------------------ the description
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("file", SHIPPED, ids=name)
def test_the_description_is_valid_and_says_what_the_manifest_says(file: Path, fmi: int, tmp_path: Path) -> None:
    controller = controller_of(f"{file.parent.name}/{file.stem}")
    m = controller.manifest
    (tmp_path / "sources").mkdir()
    for onnxruntime in (True, False):
        made_by = identifier_of(file), tools(onnxruntime=onnxruntime)
        (tmp_path / "modelDescription.xml").write_bytes(description(controller, made_by[0], fmi, made_by[1]))
        (tmp_path / "sources" / "buildDescription.xml").write_bytes(build_description(*made_by))
        assert problems(tmp_path) == []
    model = fmpy.read_model_description(str(tmp_path))
    assert controller.sha256 in model.description
    assert model.guid == token_of(controller)
    assert float(model.defaultExperiment.stepSize) == m.period_s
    variables = {v.name: v for v in model.modelVariables}
    wanted = {f"{group}.{s.name}": s for group in m.inputs if group != "state" for s in m.signals(group)}
    wanted |= {f"{group}.{s.name}": s for group in ("mv", "mv_start") for s in m.mv}
    for key, s in wanted.items():
        v = variables.pop(key)
        assert (float(v.min), float(v.max), v.unit or "-") == (s.low, s.high, s.unit or "-")
        assert v.start is None if key.startswith("mv.") else float(v.start) == s.middle
        assert v.description
        if s.values is not None:
            assert f"allowed: {', '.join(f'{x:g}' for x in s.values)}" in v.description
    assert {f"info.{n}" for n in m.info} | {"fault"} == {n for n, v in variables.items() if v.causality == "output"}


def test_names_that_xml_cannot_hold_or_that_are_one_twice_are_refused(tmp_path: Path) -> None:
    m = controller_of(PID).manifest
    for names, words in ((("a\x01",), "cannot hold"), (("a b", "a\tb"), "would be named 'info.a b'")):
        with pytest.raises(HostError, match=words):
            variables_of(replace(m, info=names))
    odd = copy.copy(controller_of(PID))
    odd.manifest = replace(m, law="pid\uffff")
    with pytest.raises(HostError, match="cannot hold"):
        description(odd, "pid", 2, tools())


@pytest.mark.parametrize("fmi", [2, 3])
def test_an_fmu_of_plain_c_holds_all_its_sources_and_nothing_of_onnxruntime(fmi: int, tmp_path: Path) -> None:
    folder = unpacked(PID, fmi)
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert {"documentation/index.html", "resources/controller.json", "sources/law.c", f"sources/fmi{fmi}.c"} <= names
    assert not [name for name in names if "onnx" in name or name.endswith("host.c")]
    page = (folder / "documentation" / "index.html").read_text()
    assert controller_of(PID).sha256 in page
    assert "mv_start.T_j" in page
    model = fmpy.read_model_description(str(folder))
    listed = model.buildConfigurations[0].sourceFileSets[0].sourceFiles
    assert listed == [f"fmi{fmi}.c", "law.c"]
    tools().compile([folder / "sources" / name for name in listed], tmp_path / "again.so")
    (library,) = (folder / "binaries").rglob("*.so")
    assert (tmp_path / "again.so").read_bytes() == library.read_bytes()


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_tool_can_compile_the_sources_of_an_fmu(fmi: int, tmp_path: Path) -> None:
    """fmpy's own build, of what the description lists; the library that came with the FMU is gone."""
    folder = tmp_path / "fmu"
    shutil.copytree(unpacked(PID, fmi), folder)
    shutil.rmtree(folder / "binaries")
    (tmp_path / "build").mkdir()
    importlib.import_module("fmpy.build").build_platform_binary(folder, tmp_path / "build")
    with closing(Unit(folder)) as u:
        assert compared(controller_of(PID), answers_of(PID), u)[""] > 300


def test_the_largest_controller_makes_a_small_fmu(tmp_path: Path) -> None:
    largest = max(SHIPPED, key=lambda file: file.stat().st_size)
    pack(unpacked(f"{largest.parent.name}/{largest.stem}", 3), tmp_path / "largest.fmu")
    assert (tmp_path / "largest.fmu").stat().st_size <= 500_000


@pytest.mark.parametrize("fmi", [2, 3])
def test_an_fmu_may_hold_onnxruntime_instead(fmi: int) -> None:
    folder = unpacked(PID, fmi, onnxruntime=True)
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*")}
    assert {"resources/controller.onnx", "documentation/licenses/onnxruntime-LICENSE.txt", "sources/host.c"} <= names
    assert not [name for name in names if "law.c" in name]
    assert any(name.endswith("libonnxruntime.so.1") for name in names)
    assert problems(folder) == []
    with closing(Unit(folder)) as u:
        seen = compared(controller_of(PID), answers_of(PID, onnxruntime=True), u)
    assert seen[""] > 300


# ------------------------------------------------------------------ in a tool: fmpy's own simulation, and a plant
PERIODS = 120


def closed_loop(of: str, act: Callable[[Array, Array], Array]) -> tuple[Array, Array]:
    """``act(sp, pv)`` gives the MV; over the case's plant, from rest to another set point: PVs, MVs, a row a period."""
    plant = PLANTS[controller_of(of).manifest.case]()
    sp = plant.sp_signals[0]
    (x, _), wanted = plant.steady_state_at(sp.low + 0.3 * (sp.high - sp.low)), sp.low + 0.6 * (sp.high - sp.low)
    p, pvs, mvs = plant.parameters(), [], []
    for _ in range(PERIODS):
        pvs.append(plant.measure(x))
        mvs.append(act(np.array([wanted]), pvs[-1]))
        x = plant.step(x, mvs[-1], plant.dv_nominal, p)
    return np.array(pvs), np.array(mvs)


def by_python(of: str) -> tuple[Array, Array]:
    controller = controller_of(of)
    mv, state = np.array([s.middle for s in controller.manifest.mv]), controller.cold_state()
    law = PlainSteps(controller)

    def act(sp: Array, pv: Array) -> Array:
        nonlocal mv, state
        mv, state, _ = law.step(sp=sp, pv=pv, mv_applied=mv, state=state)
        return mv

    return closed_loop(of, act)


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("of", [PID, "thiosulfate_cstr/forward_dob"])
def test_the_closed_loop_of_an_fmu_is_that_of_python(of: str, fmi: int, opened: ExitStack) -> None:
    u = unit(opened, of, fmi).begin()

    def act(sp: Array, pv: Array) -> Array:
        u.set(sp=sp, pv=pv)
        u.step(controller_of(of).manifest.period_s)
        return u.get("mv")

    ours, theirs = closed_loop(of, act), by_python(of)
    assert [a.tobytes() for a in ours] == [a.tobytes() for a in theirs]
    cv, wanted = theirs[0][:, 0], 0.6
    assert abs(cv[0] - 0.3) < 1e-6
    assert abs(cv[-1] - wanted) < 0.02  # the loop did follow, so the MVs compared were those of a controller


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_tool_that_knows_nothing_of_us_simulates_the_file(fmi: int, tmp_path: Path) -> None:
    """fmpy's own master on the zipped FMU, its inputs the course of a closed loop: the same MVs, a step later."""
    pack(unpacked(PID, fmi), tmp_path / "pid.fmu")
    assert problems(tmp_path / "pid.fmu") == []
    (pv, mv), period = by_python(PID), controller_of(PID).manifest.period_s
    course = np.array(
        [(k * period, 0.6, *row) for k, row in enumerate(pv)],
        dtype=[("time", float), ("sp.C_A", float), ("pv.C_A", float), ("pv.T", float)],
    )
    found = fmpy.simulate_fmu(
        str(tmp_path / "pid.fmu"), stop_time=(PERIODS - 1) * period, step_size=period, output_interval=period,
        input=course, output=["mv.T_j", "fault"],
    )  # fmt: skip
    assert found["time"].tolist() == course["time"].tolist()
    assert found["mv.T_j"].tolist() == [250.0, *mv[:-1, 0]]
    assert not found["fault"].any()


@pytest.mark.parametrize("fmi", [2, 3])
def test_an_fmu_may_lie_in_a_folder_of_any_name(fmi: int, tmp_path: Path) -> None:
    (tmp_path / "50% of \u00fc #1").symlink_to(unpacked(PID, fmi))  # FMI 2.0 gives it as a URI, with escapes
    with closing(Unit(tmp_path / "50% of \u00fc #1")) as u:
        u.begin().step(0.5)
        assert not u.fault


def test_the_same_controller_gives_the_same_file(tmp_path: Path) -> None:
    for k in (1, 2):
        folder = tmp_path / str(k)
        folder.mkdir()
        write_folder(controller_of(PID), folder, 3, tools())
        pack(folder, tmp_path / f"{k}.fmu")
    assert (tmp_path / "1.fmu").read_bytes() == (tmp_path / "2.fmu").read_bytes()
