"""Descriptions for MLflow's registry: HTML, because its Markdown has no tables.

Pictures are linked relative to the server's root, through its get-artifact route: the registry
strips ``data:`` images and every size or style, so pictures are drawn in the size they are shown.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from html import escape

from loopwright.pipeline.evaluation.law_evidence import FormAnalysis
from loopwright.pipeline.evaluation.leaderboard import because
from loopwright.pipeline.evaluation.metric import ratio_to_bound, with_unit
from loopwright.pipeline.evaluation.validation import Validation
from loopwright.pipeline.simulation.scenario import NOISE_SUFFIX
from loopwright.pipeline.tracking.gate import Gate, Rank
from loopwright.serving.certificate import CertificateRead

GAP = "&nbsp;" * 4
"""Cells have no padding there and may not be styled."""


def model_description(case: str, law: str, validation: Validation | None, champion: str | None) -> str:
    """The registered model's description: where the controller stands in its case, and how to take it.

    ``champion`` is the registered model that holds the case's alias ``champion``.
    """
    title, place = (law, case) if validation is None else (validation.titles.laws.get(law, law), validation.titles.case)
    name = f"{case}-{law}"
    take = case if name == champion else name
    return (
        f"<p>{escape(standing(name, law, validation, champion)[1])}</p>"
        f"{_grounds(validation)}"
        f"<p><b>{escape(title)}</b> for {escape(place)}. "
        "Each version is one ONNX file that holds the whole control law: scaling, limits, anti-windup.</p>"
        f"<p>Take it: <code>loopwright registry fetch {escape(take)} FOLDER</code></p>"
        "<p><b>candidate</b>: the newest version. <b>best</b>: the best version that passed the gate. "
        "<b>champion</b>: the best controller of the case; one in a case has it.</p>"
    )


def standing(name: str, law: str, validation: Validation | None, champion: str | None) -> tuple[str, str]:
    """Where a controller stands: in a few words for the list of models, and in a sentence or two without markup."""
    gate = Gate.of(validation, law)
    rank, score, none = Rank.of_laws(validation).get(law), gate.score, _no_baseline(gate)
    if rank is None or score is None:
        return "not compared yet", "Not compared yet: the report stage of its case has not run."
    place, ratio = f"{rank.place} of {rank.of}", f"{score:.3f} times {gate.reference}"
    if name == champion and rank.place == 1:
        return f"champion, {place}", f"CHAMPION: the best of the {rank.of} controllers of its case, {ratio}.{none}"
    if name == champion:
        return f"champion, {place}", f"CHAMPION of its case, {ratio}; rank {place} in the newest comparison.{none}"
    best = f"The champion is {champion}." if champion else "The case has no champion."
    if rank.refusal:
        sentence = f"Rank {place}, {ratio}. It does not pass the gate: {rank.refusal}. {best}"
        return f"{place}, did not pass the gate", sentence
    return place, f"Rank {place}, {ratio}. {best}{none}"


def version_description(
    validation: Validation | None,
    gate: Gate,
    run_id: str,
    picture: str | None,
    signed: str = "",
    operated: Mapping[str, str] | None = None,
    certificate: CertificateRead | None = None,
) -> str:
    """A version's description: verdict, signer, certificate, evidence per scenario, analysis, picture of the loop.

    ``operated`` are the pictures of tests in which operators change something, by test: the worst of them is shown.
    """
    parts = [_verdict(gate), f"<p>Signed by {escape(signed)}.</p>" if signed else "", _grounds(validation)]
    parts += [_certificate(certificate)] if certificate is not None else []
    if validation is not None:
        parts += [_table(validation, gate), _operated(validation, gate.law), _analysis(validation, gate.law)]
    if picture:
        alt = "Closed loop on the test that weighs most, beside the baseline of the case"
        parts.append(_image(picture, run_id, alt))
    if validation is not None and operated:
        parts.append(_worst(validation, gate.law, run_id, operated))
    return "\n".join(filter(None, parts))


def _grounds(validation: Validation | None) -> str:
    """The basis of figures of tests on identified models; nothing where tests ran on a plant's equations."""
    if validation is None or validation.grounds is None:
        return ""
    return f"<p>Every figure was measured {escape(validation.grounds.words)}; none on the plant.</p>"


def _certificate(read: CertificateRead) -> str:
    """The certificate's sentence, and what it rests on as a list; nothing for a file without one."""
    if read.wrong:
        return f"<p>Its certificate is NOT TO BE BELIEVED: {escape(read.wrong)}.</p>"
    if read.certificate is None:
        return ""
    sentence, *grounds = read.lines
    listed = "".join(f"<li>{escape(words)}</li>" for words in grounds)
    return f"<p><b>Certificate</b>: {escape(sentence)}.</p><ul>{listed}</ul>"


def _verdict(gate: Gate) -> str:
    """The first line, without markup: lists of versions show it as it is."""
    if gate.score is None:
        return "No closed-loop evidence yet: the report stage of its case has not run.\n"
    other = gate.baseline is not None and gate.law != gate.baseline_law and not gate.no_baseline
    beside = f", {gate.baseline_name} {gate.baseline:.3f}" if other else ""
    one = "perfect-model NMPC" if gate.reference == "the bound" else gate.reference
    score = f"Gate score {gate.score:.3f} (1 = {one}{beside})"
    if not gate.lock_ups:
        if gate.swings:
            return (
                f"SWINGS to the end in {gate.swings}. {score}, no lock-up.{escape(_no_baseline(gate), quote=False)}\n"
            )
        return f"{score}, no lock-up.{escape(_no_baseline(gate), quote=False)}\n"
    where = f": {gate.locked_up}" if gate.locked_up else ""
    return f"LOCKED UP in {gate.lock_ups} closed loops{where}; do not run it on a plant. {score}.\n"


def _no_baseline(gate: Gate) -> str:
    """A sentence, after a space, for a law that had no baseline to beat; else nothing."""
    if not gate.no_baseline or gate.law == gate.baseline_law:
        return ""
    return f" There was no {gate.baseline_name} to beat, {because(gate.no_baseline)}"


def _table(validation: Validation, shown: Gate) -> str:
    law = shown.law
    scenarios, metric, titles = validation.scenarios, validation.metric, validation.titles
    heads = [f"Scenario ({with_unit(titles.metric, titles.unit)})", "this law", "range over seeds", "with noise"]
    heads += [shown.baseline_name, "NMPC", "ratio"]
    rows = []
    for name, laws in scenarios.items():
        own = laws.get(law)
        if name.endswith(NOISE_SUFFIX) or not own:
            continue
        error, bound = own.get(metric), validation.bound(name)
        ratio = None if error is None or bound is None else ratio_to_bound(error, bound, validation.floor(name))
        spread = [own.get(f"{metric}_min"), own.get(f"{metric}_max")]
        rows.append(
            [
                escape(titles.scenarios.get(name, name)),
                _figure(error),
                "" if None in spread else " … ".join(map(_figure, spread)),
                _figure(scenarios.get(name + NOISE_SUFFIX, {}).get(law, {}).get(metric)),
                _figure(laws.get(shown.baseline_law, {}).get(metric)),
                _figure(bound),
                "" if ratio is None else f"{ratio:.2f}",
            ]
        )
    return _html_table(heads, rows) if rows else ""


def _operated(validation: Validation, law: str) -> str:
    """A table of the tests in which operators change more than set points; nothing for a law without such tests."""
    result = validation.laws.get(law)
    rows = [
        [escape(test.title), *(_percent(of) for of in (test.outside, test.late, test.gain, test.borne))]
        for test in (result.operated if result else {}).values()
    ]
    heads = ["Operators' changes", "outside ranges", "in the end", "share of the gain", "borne by the last rank"]
    return _html_table(heads, rows) if rows else ""


def _worst(validation: Validation, law: str, run_id: str, pictures: Mapping[str, str]) -> str:
    """The picture of the test that ends outside its ranges longest, and where the others are."""
    result = validation.laws.get(law)
    tests = result.operated if result else {}
    drawn = [(test.late or 0.0, name) for name, test in tests.items() if name in pictures]
    if not drawn:
        return ""
    name = max(drawn)[1]
    title = tests[name].title
    words = f"Outside its ranges longest in the end: {title}. Pictures of all such tests: folder operated of the run."
    return f"<p>{escape(words)}</p>{_image(pictures[name], run_id, escape(title))}"


def _image(path: str, run_id: str, alt: str) -> str:
    return f'<p><img src="get-artifact?path={path}&run_uuid={run_id}" alt="{alt}"></p>'


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.3g} %"


def _html_table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    head = "".join(f"<th>{cell}{GAP}</th>" for cell in heads)
    body = "".join("<tr>" + "".join(f"<td>{cell}{GAP}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def analysis_figures(validation: Validation | None, law: str) -> dict[str, float]:
    """The figures of a law's analysis, of its shipped form, by name; empty where it has none."""
    return {} if validation is None else dict(_analysed(validation, law).figures)


def _analysed(validation: Validation, law: str) -> FormAnalysis:
    result = validation.laws.get(law)
    return (result.analysis.get("base") if result else None) or FormAnalysis()


def _analysis(validation: Validation, law: str) -> str:
    words, analysis = validation.titles.figures, _analysed(validation, law)
    if not analysis.figures and not analysis.notes:
        return ""
    rows = [(escape(words.get(n, n.replace("_", " "))), _figure(value)) for n, value in analysis.figures.items()]
    listed = "".join(f"<li>{escape(note)}</li>" for note in analysis.notes)
    return (_html_table(("Analysis", ""), rows) if rows else "<p>Analysis</p>") + (listed and f"<ul>{listed}</ul>")


def _figure(value: float | None) -> str:
    return "" if value is None else f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
