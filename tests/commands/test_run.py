"""What ``loopwright run`` says beforehand: which stages run, and why."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from loopwright.pipeline.__main__ import main
from loopwright.pipeline.commands import run
from loopwright.pipeline.commands.run import chain_of, plan, reasons, side_by_side, stages_of
from loopwright.pipeline.errors import ParamsError, PipelineError

ROOT = Path(__file__).parents[2]


def test_a_name_asks_for_its_stages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    assert stages_of("batch_reactor") == ["report@batch_reactor"]
    assert stages_of("batch_reactor-pid") == ["validate@batch_reactor-pid"]
    assert stages_of("batch_reactor-nnarx") == ["fit@batch_reactor-nnarx"]
    assert stages_of("batch_reactor-batches") == ["excite@batch_reactor-batches"]
    with pytest.raises(ParamsError, match="no case, controller, model or record 'batch_reacto'; did you mean"):
        stages_of("batch_reacto")


def test_reasons_are_words_for_what_dvc_says() -> None:
    deps = {"changed deps": {"params.yaml": {"controllers.x.kc": "modified"}, "work/a": "deleted"}}
    said = reasons([deps, {"changed outs": {"work/b": "modified"}}, "changed command"])
    assert said == ["controllers.x.kc is modified", "work/a is not there", "work/b is modified", "changed command"]
    listed = {"changed deps": {"work/code/screen-tank.json": "modified"}}
    assert reasons([listed]) == ["its code has changed, or a file that it reads"]


@pytest.mark.parametrize("how", ["deleted", "not in cache"])  # of a new section; of a fresh clone
def test_a_stage_that_never_ran_is_not_said_to_be_deleted(how: str) -> None:
    said = reasons([{"changed deps": {"work/a": "deleted"}}, {"changed outs": {"work/b": how, "c.onnx": "modified"}}])
    assert said == ["never run here, or its results were removed"]


def test_a_dry_run_leaves_the_stages_to_a_run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """DVC is asked for its status and its graph alone: a stage that it runs would change dvc.lock."""
    asked: list[list[str]] = []

    def dvc(*commands: list[str]) -> list[str]:
        asked.extend(commands)
        return ['{"code": ["changed command"]}', ""]

    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(run, "ask", None)
    monkeypatch.setattr(run, "ask_in_turn", dvc)
    monkeypatch.setattr(run, "list_files", lambda: None)
    assert main(["run", "--dry"]) == 0
    assert asked == [["status", "--json"], ["dag", "--dot"]]
    assert capsys.readouterr().out == "nothing has changed; everything is up to date\n"


def test_dvc_is_told_of_the_list_of_files_and_does_not_make_it_again(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []

    def dvc(*arguments: str, finish: bool = False) -> str:
        done.append(" ".join(arguments) + " to its end" * finish)
        return ""

    def in_turn(*commands: list[str]) -> list[str]:
        done.extend(" ".join(command) for command in commands)
        return ["{}", ""]

    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(run, "mistakes", list)
    monkeypatch.setattr(run, "list_files", lambda: done.append("listed"))
    monkeypatch.setattr(run, "ask", dvc)
    monkeypatch.setattr(run, "ask_in_turn", in_turn)
    monkeypatch.setattr(run, "show_results", lambda *_, **__: None)
    assert main(["run"]) == 0
    assert done == ["listed", "commit --force code to its end", "status --json", "dag --dot"]


def test_a_first_step_that_fails_says_what_to_do(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def dvc(*_: str, **__: bool) -> str:
        raise PipelineError("dvc repro failed: code: No module named 'grimp'")

    monkeypatch.setattr(run, "mistakes", list)
    monkeypatch.setattr(run, "ask", dvc)
    assert main(["run"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "no stage ran (dvc repro failed: code: No module named 'grimp'); mend that and run again" in said


def test_ctrl_c_before_the_stages_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted() -> list[str]:
        raise KeyboardInterrupt

    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(run, "mistakes", interrupted)
    assert main(["run", "batch_reactor"]) == 130
    said = "stopped; finished stages are kept, `loopwright run batch_reactor` goes on from there\n"
    assert capsys.readouterr() == ("", said)


def test_a_case_without_any_controller_ends_with_a_status_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(run, "mistakes", list)
    monkeypatch.setattr(run, "list_files", lambda: None)
    monkeypatch.setattr(run, "ask", lambda *_, **__: "")
    monkeypatch.setattr(run, "ask_in_turn", lambda *_: ["{}", ""])
    monkeypatch.setattr(run, "stages_of", lambda name: [f"report@{name}"])
    monkeypatch.setattr(run, "brought_up", lambda: False)
    shown: list[str | None] = []
    monkeypatch.setattr(run, "show_results", lambda _, case: shown.append(case))
    folder = tmp_path / "artifacts" / "tank"
    folder.mkdir(parents=True)
    (folder / "validation.json").write_text("{}")
    (folder / "pid.json").write_text('{"withheld": "it locked up"}')
    assert main(["run", "tank"]) == 1
    assert main(["run"]) == 0  # the other cases have theirs
    (folder / "other.onnx").write_bytes(b"a controller")
    assert main(["run", "tank"]) == 0
    assert shown == ["tank", None, "tank"]


def test_the_overview_follows_the_run_of_one_case(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """DVC makes the stage `overview` with the reports of all cases only: it is told that these pages are its output."""
    told: list[tuple[str, ...]] = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(run, "mistakes", list)
    monkeypatch.setattr(run, "list_files", lambda: None)
    monkeypatch.setattr(run, "ask", lambda *said, **_: told.append(said) or "")
    monkeypatch.setattr(run, "status", lambda _: ({}, ""))
    monkeypatch.setattr(run, "show_results", lambda *_, **__: None)
    (tmp_path / "params.yaml").write_text("cases: {batch_reactor: {}, reversible_cstr: {}, thiosulfate_cstr: {}}\n")
    for case in ("batch_reactor", "reversible_cstr"):
        shutil.copytree(ROOT / "artifacts" / case, tmp_path / "artifacts" / case)
    assert main(["run", "reversible_cstr"]) == 0
    page = (tmp_path / "artifacts" / "report.md").read_text()
    assert "(batch_reactor/report.md)" in page
    assert "(reversible_cstr/report.md)" in page
    assert ("commit", "--force", "overview") in told
    told.clear()
    assert main(["run", "reversible_cstr"]) == 0
    assert ("commit", "--force", "overview") not in told


def test_a_part_runs_where_no_report_was_made_yet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(run, "ARTIFACTS", tmp_path)
    monkeypatch.setattr(run, "mistakes", list)
    monkeypatch.setattr(run, "list_files", lambda: None)
    monkeypatch.setattr(run, "ask", lambda *_, **__: "")
    monkeypatch.setattr(run, "status", lambda _: ({}, ""))
    assert main(["run", "ph_neutralization-nnarx"]) == 0
    assert "`loopwright run CASE` makes the report" in capsys.readouterr().out


def test_the_plan_names_every_stage_or_counts_many() -> None:
    assert plan({}, 0) == ["nothing has changed; everything is up to date"]
    few = plan({"fit@a": ["models.a is modified"]}, 4)
    assert few[0] == "1 stage has changed; with what depends on that at most 4 run. Changed:"
    assert "fit@a  models.a is modified" in few[1]
    many = plan({f"{kind}@{i}": ["new"] for kind in ("fit", "design") for i in range(20)}, 50)
    assert [line.split() for line in many[1:]] == [["fit", "20"], ["design", "20"]]


def test_cases_with_changes_run_side_by_side(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    chain = chain_of("batch_reactor")
    assert chain[0] == "excite@batch_reactor-batches"
    assert chain[-1] == "report@batch_reactor"
    kinds = [stage.partition("@")[0] for stage in chain]
    assert kinds == sorted(kinds, key=["excite", "fit", "design", "validate", "report"].index)
    assert not any("15s" in stage for stage in chain_of("ph_neutralization"))
    found = side_by_side([], ["fit@batch_reactor-nnarx", "report@ph_neutralization", "overview"])
    assert [chain[-1] for chain in found] == ["report@ph_neutralization", "report@batch_reactor"]
    asked = ["report@batch_reactor", "report@reversible_cstr"]
    assert len(side_by_side(asked, ["report@batch_reactor", "report@reversible_cstr"])) == 2


def test_one_case_or_a_part_of_one_runs_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    assert side_by_side([], ["fit@batch_reactor-nnarx"]) == []
    both = ["fit@batch_reactor-nnarx", "report@reversible_cstr"]
    assert side_by_side(["report@reversible_cstr"], both) == []
    assert side_by_side(["fit@batch_reactor-nnarx", "report@reversible_cstr"], both) == []


def test_a_case_that_reads_the_record_of_another_is_no_chain(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (ROOT / "params.yaml").read_text()
    (tmp_path / "params.yaml").write_text(
        text.replace("data: work/batch_reactor/records/batches", "data: work/reversible_cstr/records/aprbs", 1)
    )
    monkeypatch.chdir(tmp_path)
    assert side_by_side([], ["report@batch_reactor", "report@reversible_cstr"]) == []
