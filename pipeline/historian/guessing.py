"""Guesses of what the columns of an export are, for the table that a person corrects."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.historian.answers import first_answer
from loopwright.pipeline.historian.arx_model import fit_arx
from loopwright.pipeline.historian.cleaning.outliers_and_units import slips_of, usual
from loopwright.pipeline.historian.cleaning.row_grid import resampled
from loopwright.pipeline.historian.cleaning.sampling import proposed_period
from loopwright.pipeline.historian.cleaning.tag_checks import sentinels
from loopwright.pipeline.historian.cleaning.tags import GUESSED_PAD, NO_LOOP, Guess, Look, Tag, automatic, by_hand
from loopwright.pipeline.historian.excitation import FEEDBACK_SHARE, FEW_MOVES, SEEN_STRENGTH, moves_of
from loopwright.pipeline.historian.feedback import follows
from loopwright.pipeline.historian.files.export import Export, Series
from loopwright.pipeline.historian.files.quality import Reason
from loopwright.pipeline.historian.files.signal_statistics import smallest_difference
from loopwright.pipeline.metrics import Array

ENDINGS: tuple[tuple[str, str], ...] = (
    (r"(mode|modus|betriebsart|md|auto)$", "mode"),
    (r"(^|[ ._:/-])(sp|spt|setpoint|set point|sollwert|w)([ ._:/-]|$)", "sp"),
    (r"(^|[ ._:/-])(op|out|mv|co|valve|stellwert|y)([ ._:/-]|$)", "mv"),
    (r"(^|[ ._:/-])(pv|cv|me|meas|istwert|x)([ ._:/-]|$)", "pv"),
    # Words that mean something else elsewhere: an SV in front is a solenoid valve.
    (r"[ ._:/-](sv|sw|set[ _-]?(value|pt)|target|soll|consigne|consigna)$", "sp"),
    (r"[ ._:/-](output|lmn|stellgr(ö|oe)(ß|ss)e)$", "mv"),
    (r"[ ._:/-](ist|mw)$", "pv"),
)
SWITCH = re.compile(r"[ ._:/-]sw$", re.IGNORECASE)
"""A Sollwert; a switch where its values are 0 and 1."""
ATTRIBUTE = re.compile(
    r"([ ._:/-](?:mode|sp|sv|sw|op|out|output|lmn|mv|co|pv|mw))[./#](cv|f_cv|value|val|actual)$", re.IGNORECASE
)
"""The current value of a parameter, as SP.CV and MODE.ACTUAL: the parameter's name says what it is."""
CONTROL_VARIABLE = re.compile(r"[ ._:/-]cv$", re.IGNORECASE)
FLOW = re.compile(
    r"flow|flu(ss|ß)|(zu|ab|aus|ein)lauf|durchsatz|feed|discharge|throughput|d[ée]bit|caudal|portata"
    r"|^([0-9]{1,3}[ ._:/-]?)?f[a-z]{0,3}[ _-]?[0-9]",
    re.IGNORECASE,
)
FLOW_UNIT = re.compile(
    r"^((n|s|k|kn|ks)?m3|(n|s|k|kn|ks)?m³|k?g|t|[mhn]?l|lbs?|gal|bbl|k?mol|[ak]?scf|cf|ft3|ft³)"
    r"/(s|sec|min|mn|h|hr|hour|std|d|day|tag)$"
    r"|^((us|imp)?gp[mhd]|[ns]?lp[mh]|[as]?cf[mh]|sccm|slm|[mk]?scfd|bpd|mgd|tph|kgh|m3h)$",
    re.IGNORECASE,
)
NO_FLOW = re.compile(
    r"temp|level|niveau|f(ü|ue)llstand|press|druck|conc|speed|drehzahl|valve|ventil|vanne|v[áa]lvula|valvola|stell|damper",
    re.IGNORECASE,
)
"""Words of other quantities: F101 Temp is a temperature, and a flow valve moves one."""
LABEL = re.compile(
    r"(^|[ ._:/-])("
    r"batch|lot|campaign|grade|product|recipe|phase|shift|crew|order|state|status|alarm|fault|code|count(er)?"
    r"|(charge|los|produkt|rezept|sorte|schicht|auftrag|artikel|kampagne|phase|schritt|zustand|st(ö|oe)rung|z(ä|ae)hler)\w*"
    r"|\w+nummer|recette|produit|[ée]quipe|num[ée]ro|lote|receta|producto|turno|lotto|ricetta|prodotto"
    r")([ ._:/-]|$)"
    r"|(^|[ ._:/-])(no|nr|id|n°|nº)\.?$",
    re.IGNORECASE,
)
HELD_SHARE = 0.9  # of the readings equal to the one before: moved in steps
LEAST_GOOD = 0.5  # share of the readings of a tag that is tried as a disturbance
MOST_GUESSED_TAGS, MOST_GUESSED_READINGS = 60, 20_000  # tags whose role is guessed, and readings of each
GUESS_STRENGTH = 25.0  # strength of an answer, as SEEN_STRENGTH of excitation, for a guess
LOOP = re.compile(r"^(?P<loop>.*?)[ ._:/-]+[A-Za-z ]+$")


def guesses(export: Export, units: Mapping[str, str]) -> list[Guess]:
    """One guess for every column, in the order of the file."""
    found = [_guess(s, units.get(name, "")) for name, s in export.series.items()]
    found = [_mode_of(_output(g, found), found, export.series[g.tag.tag]) for g in found]
    named = {g.tag.tag for g in found if g.tag.role == "pv" and not _is_flow(g)}
    found = _without_loop([_cascaded(g, found) for g in found], flows=True)
    if not any(g.tag.role == "mv" for g in found):  # names say nothing: what moves in steps may be one
        moved = [g for g in found if not g.tag.role and g.look is Look.STEPS]
        moved = [g for g in moved if not _is_flow(g)] or moved  # a feed that others set, where a valve is there
        found = [g.as_role("mv", "guessed: moves in steps") if g in moved else g for g in found]
    if not any(g.tag.role == "pv" for g in found):
        loops = {loop for g in found if g.tag.role in {"mv", "sp"} and (loop := loop_of(g.tag.tag))}
        free = [g for g in found if not g.tag.role and g.good > 0 and g.step >= 0 and g.tag.low is not None]
        free = [g for g in free if g.look is not Look.LABEL]
        own = [g for g in free if g.tag.tag in loops] or [g for g in free if not _is_flow(g)][:1] or free[:1]
        found = [g.as_role("pv") if g in own else g for g in found]
    # A variable that looks like a PV and answers to nothing may drift as the PVs do: no guess makes it a cause of them.
    answering = without_answers(found, export)
    taken = named | {g.tag.tag for g in found if g.tag.role == "pv"}
    return _modes_of_blocks([_with_loop(g) for g in disturbances(_without_loop(answering), export, taken)])


def _parameter(tag: str) -> str:
    """The tag without the attribute of a parameter, as TIC-1/SP of TIC-1/SP.CV."""
    return ATTRIBUTE.sub(r"\1", tag)


def loop_of(tag: str) -> str:
    """The loop that a tag belongs to by its name, as TIC-1 of TIC-1.SP and TIC-1/SP.CV; empty where it names none."""
    match = LOOP.match(_parameter(tag))
    return match["loop"] if match else ""


def _with_loop(guess: Guess) -> Guess:
    """The guess with the loop that its name says, for a person to correct; a disturbance is in none."""
    role = guess.tag.role
    return guess if role in {"", "dv"} else replace(guess, tag=replace(guess.tag, loop=loop_of(guess.tag.tag)))


def _modes_of_blocks(found: Sequence[Guess]) -> list[Guess]:
    """The guesses, a mode of a whole module with the one loop within it, as FIC1/MODE with FIC1/PID1/OUT."""
    loops = {g.tag.loop for g in found if g.tag.role in {"pv", "mv", "sp"} and g.tag.loop}
    changed = []
    for g in found:
        inner = [loop for loop in loops if re.match(re.escape(g.tag.loop) + r"[ ._:/-]", loop)]
        alone = g.tag.role == "mode" and g.tag.loop and g.tag.loop not in loops and len(inner) == 1
        changed.append(replace(g, tag=replace(g.tag, loop=inner[0])) if alone else g)
    return changed


def loop_in(tag: Tag) -> str:
    """The loop that a tag belongs to: as a person said, else by its name; empty where it belongs to none."""
    return "" if tag.loop == NO_LOOP else tag.loop or loop_of(tag.tag)


def _is_flow(guess: Guess) -> bool:
    """Whether a tag is a flow by its unit, or by its name where the unit does not say another."""
    unit = guess.tag.unit.strip()
    if FLOW_UNIT.match(unit):
        return True
    return unit in {"", "%", "-", "1"} and bool(FLOW.search(guess.tag.tag)) and not NO_FLOW.search(guess.tag.tag)


def _without_loop(found: Sequence[Guess], *, flows: bool = False) -> list[Guess]:
    """The guesses, variables (or ``flows`` alone) that no loop holds without a role, where another PV is there.

    An outflow through an MV's valve follows the MV, and a feed disturbs: neither is what a controller shall hold. Nor
    is any other variable, where some PV has a loop and there are more PVs than MVs to hold them.
    """
    held = {loop for g in found if g.tag.role in {"sp", "mv", "mode"} and (loop := loop_of(g.tag.tag))}
    pvs, n_mv = [g for g in found if g.tag.role == "pv"], sum(g.tag.role == "mv" for g in found)
    alone = [g for g in pvs if (loop_of(g.tag.tag) or g.tag.tag) not in held]
    if flows or len(alone) == len(pvs) or len(pvs) <= n_mv:
        alone = [g for g in alone if _is_flow(g)]
    if len(alone) == len(pvs):
        return list(found)
    note = "without a loop of its own: role pv if it is to be controlled, dv if it disturbs"
    return [g.as_role("", f"a {'flow' if _is_flow(g) else 'variable'} {note}") if g in alone else g for g in found]


def _output(guess: Guess, found: Sequence[Guess]) -> Guess:
    """The guess; an MV where it is the CV of a loop with a PV, and no loop has an output: some systems call it so."""
    loop = loop_of(guess.tag.tag)
    if guess.tag.role != "pv" or not loop or not CONTROL_VARIABLE.search(_parameter(guess.tag.tag)):
        return guess
    beside = any(g is not guess and g.tag.role == "pv" and loop_of(g.tag.tag) == loop for g in found)
    if not beside or any(g.tag.role == "mv" for g in found):
        return guess
    return guess.as_role("mv", "guessed: the loop has a PV beside it")


def _mode_of(guess: Guess, found: Sequence[Guess], series: Series) -> Guess:
    """The guess; the mode of its loop where its texts say who moves the MV, whatever the tag is called."""
    loop, of = loop_of(guess.tag.tag), guess.tag.tag
    if guess.tag.role or guess.look is not Look.TEXTS or not loop or LABEL.search(of) or not _are_modes(series.texts):
        return guess
    loops = {loop_of(g.tag.tag) for g in found if g.tag.role in {"pv", "mv", "sp"}}
    return guess.as_role("mode", "guessed: its texts are modes") if loop in loops else guess


def _cascaded(guess: Guess, found: Sequence[Guess]) -> Guess:
    """The guess; an MV where it is the set point of a loop of which nothing else is there: a lower loop follows it."""
    loop = loop_of(guess.tag.tag)
    if guess.tag.role != "sp" or not loop or guess.tag.low is None:
        return guess
    if any(loop in {loop_of(g.tag.tag), g.tag.tag} for g in found if g is not guess):
        return guess
    return guess.as_role("mv", "guessed: the set point of a loop of which nothing else is here")


def without_answers(found: Sequence[Guess], export: Export) -> list[Guess]:
    """The guesses, PVs that answer to no MV without a role: no controller can hold them.

    All keep it where no PV answers at all, or where some MV hardly moves in the readings that are looked at: then
    they say nothing about what it moves.
    """
    pvs, mvs = ([g.tag.tag for g in found if g.tag.role == role and g.tag.low is not None] for role in ("pv", "mv"))
    if not pvs or not mvs:
        return list(found)
    own = {name: _excerpt(export.series[name], role) for role, tags in (("pv", pvs), ("mv", mvs)) for name in tags}
    grid, _ = resampled([own[n] for n in pvs], [own[n] for n in mvs], proposed_period([own[pvs[0]]]))
    u, run = [grid.value[m] for m in mvs], grid.piece
    if min(len(moves_of(v[np.isfinite(v)], run[np.isfinite(v)])) for v in u) < FEW_MOVES:
        return list(found)
    still = [name for name in pvs if not _answers(grid.value[name], u, run)]
    if len(still) == len(pvs):
        return list(found)
    note = "answers to no MV; role dv if it disturbs what the MVs move, pv if an MV moves it all the same"
    return [g.as_role("", note) if g.tag.tag in still else g for g in found]


def _answers(y: Array, u: Sequence[Array], run: NDArray[np.int64]) -> bool:
    """Whether y (n,) answers to one of the inputs u, (n,) each, by the quick model or by what follows their moves."""
    model = fit_arx(y, list(u), run)
    seen = model is not None and max(model.strength[i] for i in range(len(u))) > SEEN_STRENGTH
    return seen or any(first_answer(y, v, run) is not None for v in u)


def controlled_first(tags: Sequence[Tag]) -> tuple[Tag, ...]:
    """The tags, the PVs whose loop has a set point before the others, and those that have none by their role last."""
    loops = {loop for t in tags if t.role == "sp" and (loop := loop_in(t))}

    def place(tag: Tag) -> int:
        return 2 if tag.constraint else int(bool(loops) and tag.role == "pv" and loop_in(tag) not in loops)

    return tuple(sorted(tags, key=place))


def loops_in(tags: Sequence[Tag]) -> dict[str, dict[str, list[str]]]:
    """Loop -> role -> its tags, of the loops with two tags or more that have a role."""
    found: dict[str, dict[str, list[str]]] = {}
    for tag in tags:
        if tag.role and tag.role != "dv" and (loop := loop_in(tag)):
            found.setdefault(loop, {}).setdefault(tag.role, []).append(tag.tag)
    return {loop: roles for loop, roles in found.items() if len(roles) > 1}


def disturbances(found: Sequence[Guess], export: Export, taken: Collection[str] = ()) -> list[Guess]:
    """The guesses, tags without a role that a PV answers to, and that do not answer to it, as measured disturbances.

    Those ``taken`` are not tried.
    """
    pvs, mvs = ([g.tag.tag for g in found if g.tag.role == role] for role in ("pv", "mv"))
    free = [g.tag.tag for g in found if not g.tag.role and g.good > LEAST_GOOD and g.tag.low is not None]
    labels = {g.tag.tag for g in found if g.look is Look.LABEL}
    free = [tag for tag in free if tag not in taken and tag not in labels]
    if not pvs or not mvs or not free:
        return list(found)
    roles = dict.fromkeys(pvs, "pv") | dict.fromkeys(mvs, "mv") | dict.fromkeys(free[:MOST_GUESSED_TAGS], "dv")
    own = {name: _excerpt(export.series[name], role) for name, role in roles.items()}
    grid, _ = resampled(
        [own[n] for n in (*pvs, *free[:MOST_GUESSED_TAGS])], [own[n] for n in mvs], proposed_period([own[pvs[0]]])
    )
    # A flow through an MV's valve is an answer to the MV, and no cause of its own.
    moved = {n: fit_arx(grid.value[n], [grid.value[m] for m in mvs], grid.piece) for n in free[:MOST_GUESSED_TAGS]}
    consequences = {n for n, model in moved.items() if model and max(model.strength.values()) > GUESS_STRENGTH}
    causes: dict[str, str] = {}
    for pv in pvs:
        y = grid.value[pv]
        for name in free[:MOST_GUESSED_TAGS]:
            u = [*(grid.value[m] for m in mvs), grid.value[name]]
            model = fit_arx(y, u, grid.piece)
            seen = model is not None and model.strength[len(mvs)] > GUESS_STRENGTH and name not in consequences
            if seen and follows(grid.value[name], y, grid.piece) < FEEDBACK_SHARE and name not in causes:
                causes[name] = pv
    return [g.as_role("dv", f"guessed: {causes[g.tag.tag]} answers") if g.tag.tag in causes else g for g in found]


def _excerpt(series: Series, role: str) -> Series:
    """The first readings of a tag, those without a reason; codes for missing values left out."""
    n = min(len(series), MOST_GUESSED_READINGS)
    value, code = series.value[:n].copy(), series.code[:n].copy()
    codes, _ = sentinels(np.where(code == Reason.GOOD, value, np.nan), Tag(series.tag, role))
    code[codes & (code == Reason.GOOD)] = Reason.SENTINEL
    return Series(series.tag, series.time_s[:n], value, code)


def _guess(series: Series, unit: str) -> Guess:
    tag, good = series.tag, float(series.good.mean()) if len(series) else 0.0
    role = next((r for pattern, r in ENDINGS if re.search(pattern, _parameter(tag), re.IGNORECASE)), "")
    texts, counts = sum(series.texts.values()), series.counts()
    if texts > 0.5 * len(series):
        words = (", ".join(t for t, _ in series.texts.most_common(4)),)
        if role == "mode":
            good = 1.0 - counts.get("empty", 0) / len(series)
        return Guess(Tag(tag, "mode" if role == "mode" else "", unit), 0.0, good, Look.TEXTS, words)
    if not series.good.any():
        return Guess(Tag(tag, "", unit), 0.0, good, Look.NOTHING)
    plain, codes, found = _plain(series, Tag(tag, role, unit))
    if role == "sp" and SWITCH.search(tag) and {0.0, 1.0} >= set(np.unique(plain).tolist()):
        role = ""
    look, notes = Look.MOVES, list[str]()
    still = np.abs(np.diff(plain)) <= 0
    if np.ptp(plain) == 0:
        look, role = Look.CONSTANT, "" if role == "pv" else role
    elif not role and _counts(tag, plain):
        look = Look.LABEL
    elif still.mean() >= HELD_SHARE:
        look = Look.STEPS
    if found:
        notes.append("codes: " + ", ".join(found))
    if texts:
        notes.append("texts: " + ", ".join(repr(t) for t, _ in series.texts.most_common(3)))
    low, high = _range(plain, unit, role)
    kept = good - float(codes.mean())
    return Guess(Tag(tag, role, unit, low, high), smallest_difference(plain), kept, look, tuple(notes))


def _are_modes(texts: Counter[str]) -> bool:
    """Whether the texts of a column say who moves an MV: a controller in some rows, a person in others, and no more.

    Single letters may be grades.
    """
    kinds = [(automatic(t), by_hand(t)) for t in texts if len(t.strip()) > 2]
    said = all(a or h for a, h in kinds) and len(kinds) == len(texts)
    return said and any(a for a, _ in kinds) and any(h for _, h in kinds)


def _counts(tag: str, plain: Array) -> bool:
    """Whether whole numbers (n,) only rise, are 0 and 1, or are named as labels are: no valve moves so."""
    if not np.array_equal(plain, np.round(plain)):
        return False
    step = np.diff(plain)
    rises = bool((step >= 0).all()) and np.count_nonzero(step) > 1
    return bool(rises or np.array_equal(np.unique(plain), [0.0, 1.0]) or LABEL.search(tag))


def seen_range(series: Series) -> tuple[float, float] | None:
    """Lowest and highest reading of an MV, without codes for missing values and slips of the unit; None without any.

    The guess of an MV's range, unless its unit says more.
    """
    if not series.good.any():
        return None
    plain, _, _ = _plain(series, Tag(series.tag, "mv"))
    return (float(np.min(plain)), float(np.max(plain))) if plain.size else None


def _plain(series: Series, tag: Tag) -> tuple[Array, NDArray[np.bool_], Counter[str]]:
    """Readings that are no code for a missing value and no slip of the unit; where codes are (n,), how often each."""
    codes, found = sentinels(np.where(series.code == Reason.GOOD, series.value, np.nan), tag)
    plain = series.value[series.good & ~codes]
    return plain[~slips_of(plain, tag.role)[0]], codes, found


def _range(values: Sequence[float] | np.ndarray, unit: str, role: str) -> tuple[float | None, float | None]:
    low, high = usual(np.asarray(values, dtype=np.float64))
    if not low < high:
        low, high = float(np.min(values)), float(np.max(values))
    if not low < high:
        return None, None
    if unit == "%" and low >= 0 and high <= 100:
        return 0.0, 100.0
    if role == "mv":
        return float(np.min(values)), float(np.max(values))
    pad = GUESSED_PAD * (high - low)
    return float(f"{low - pad:.3g}"), float(f"{high + pad:.3g}")
