"""What a person reads of a run in place of DVC's lines."""

from __future__ import annotations

from pathlib import Path

import yaml

from loopwright.pipeline.engine.parallel_dvc import Announcements, words_of

ROOT = Path(__file__).parents[2]
WORDS = {"fit": "the models of the plant"}


def test_stages_are_counted_and_those_that_need_no_run_are_not() -> None:
    said = Announcements(["fit@a-one", "design@a-pid", "report@a"], WORDS).of
    assert said("Stage 'code' didn't change, skipping") is None
    assert said("Running stage 'fit@a-one':") == "stage 1 of 3: fit a-one (the models of the plant)"
    assert said("Stage 'design@a-pid' didn't change, skipping\n") is None
    cached = "Stage 'report@a' is cached - skipping run, checking out outputs"
    assert said(cached) == "stage 2 of 2: report a: made before from the same inputs, taken from the cache"
    # The look at everything that comes after the cases passes them again.
    assert said("Stage 'report@a' didn't change, skipping") is None
    assert said("Running stage 'publish':") == "stage 3 of 3: publish"


def test_lines_of_a_stage_stay_and_those_on_files_of_dvc_go() -> None:
    said = Announcements([], WORDS).of
    assert said("fit a-one: linear models: 3 of 20\n") == "fit a-one: linear models: 3 of 20"
    for line in (
        *(
            "",
            "> python -m loopwright.pipeline.engine.start fit a-one",
            "Updating lock file 'dvc.lock'",
            "\tgit add dvc.lock",
        ),
        *("To track the changes with git, run:", "Use `dvc push` to send your updates to remote storage."),
    ):
        assert said(line) is None


def test_a_failure_names_the_stage_as_its_own_lines_do() -> None:
    said = Announcements(["fit@a-one"], WORDS).of
    line = "ERROR: failed to reproduce 'fit@a-one': failed to run: python -m x fit a-one, exited with 2"
    assert said(line) == "fit a-one failed (exit status 2), its last line says why; finished stages are kept"
    assert said("ERROR: failed to reproduce 'fit@a-one': output missing") is not None


def test_every_stage_of_the_pipeline_has_words(tmp_path: Path) -> None:
    words = words_of(ROOT / "dvc.yaml")
    assert set(words) == set(yaml.safe_load((ROOT / "dvc.yaml").read_text())["stages"])
    assert all(words.values())
    assert words_of(tmp_path / "dvc.yaml") == {}
