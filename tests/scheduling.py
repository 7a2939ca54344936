"""Which worker runs which test file, so that all cores are busy and none that keeps time is late.

Files in KEEP_TIME run plants on a clock, browsers or servers that are asked in time: they mostly wait, and fail where
they are not served when they need it. The others compute. So there are two kinds of workers. Some compute, at a low
priority: as many as there are cores, since each more of them loads all libraries, which costs more than it gains. The
others, two where there are enough, keep time at the usual priority, and compute when no such file is left.
"""

from __future__ import annotations

import os
from typing import Any

import pytest
from xdist.scheduler import LoadFileScheduling
from xdist.workermanage import WorkerController

KEEPERS = 2
NICE = 10  # of the workers that compute: a core that somebody else wants has them a tenth of its time

# By their time, the longest first, so that none is waited for alone at the end.
KEEP_TIME = (
    *("test_plant_faults.py", "test_playground_in_browser.py", "test_plant_outages.py", "test_page_in_browser.py"),
    *("test_page_troubles_in_browser.py", "test_kept_sessions.py", "test_page_for_everybody_in_browser.py"),
    *(
        "test_journal_kills.py",
        "test_journal.py",
        "test_another_stack.py",
        "test_loop_command.py",
        "test_plant_wishes.py",
    ),
    *("test_page_attacks.py", "test_loop_certificates.py", "test_browser_host.py", "test_two_loops.py"),
    *("test_steering.py", "test_page_signers_in_browser.py", "test_page.py", "test_sending.py"),
    *("test_playground_of_a_made_plant_in_browser.py", "test_signed_steering.py", "test_quality.py"),
    *("test_watching.py", "test_starting.py", "test_operate_on_server.py"),
    *("test_page_faceplates_in_browser.py", "test_faceplates.py", "test_page_courses_in_browser.py"),
    *("test_page_by_hand_in_browser.py", "test_browser_module.py"),
)
LONG = (
    *("test_st_files.py", "test_predictive.py", "test_manual_builds.py", "test_pipeline.py", "test_real_servers.py"),
    *("test_drifts_of_every_case.py", "test_screen_by_dvc.py", "test_export_to_controller.py", "test_fusing.py"),
    *("test_webassembly.py", "test_regions.py", "test_step_block.py", "test_mvs_one_by_one.py", "test_fusion.py"),
    *("test_guard_block.py", "test_predictive_operating.py", "test_tracking.py", "test_local_controllers.py"),
    *("test_laws_contract.py", "test_dvc_deps.py", "test_embed.py", "test_left_out.py", "test_old_loop.py"),
    *(
        "test_statements.py",
        "test_what_if_of_courses.py",
        "test_station_world.py",
        "test_identified_part.py",
        "test_fuzz_of_operate.py",
    ),
    *("test_workbench.py", "test_cold_starts.py", "test_new.py", "test_cortex_m7.py", "test_excitation.py"),
    *("test_c_example.py", "test_c_host.py", "test_cluster_stages.py", "test_cluster.py", "test_node_host.py"),
    *("test_laws_that_are_refused.py", "test_controller_fmu.py", "test_report.py", "test_graph_audit.py"),
    *("test_report_of_squared_errors.py", "test_fuzzy_laws.py", "test_commanded_mvs.py", "test_screen.py"),
    *("test_pictures.py", "test_structure_search.py", "test_units_of_laws.py", "test_repeatable.py"),
)
RANK = {name: i for i, name in enumerate((*KEEP_TIME, *LONG))}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The long files first; xdist must be told to keep the order (``--no-loadscope-reorder``).

    A test of a file that keeps time may fail where the machine stands still, so it has a second try: at most five of a
    whole run have one, and the first failure of each is printed at the end.
    """
    items.sort(key=lambda item: RANK.get(item.path.name, len(RANK)))
    for item in items:
        if item.path.name in KEEP_TIME:
            item.add_marker(pytest.mark.flaky(reruns=1))


class TwoKinds(LoadFileScheduling):
    """Gives a worker that computes no file that keeps time, and one that keeps time those first."""

    def _assign_work_unit(self, node: WorkerController) -> None:
        fitting = self._fitting(node)
        if fitting is None:
            node.shutdown()
            return
        self.workqueue.move_to_end(fitting, last=False)
        super()._assign_work_unit(node)

    def _fitting(self, node: WorkerController) -> str | None:
        """The next file for a worker; None where there is no more."""
        if not computes(node) or all(computes(other) for other in self.nodes):  # of one file there is one worker
            return next(iter(self.workqueue), None)
        return next((scope for scope in self.workqueue if scope.rpartition("/")[2] not in KEEP_TIME), None)


def computes(node: WorkerController) -> bool:
    """Whether a worker is one of those that compute: all but KEEPERS, of three and less all but one."""
    n = node.workerinput["workercount"]
    return int(node.gateway.id.removeprefix("gw")) % n < n - min(KEEPERS, (n + 1) // 2)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> TwoKinds | None:
    """Called where there are several workers."""
    return TwoKinds(config, log) if config.getoption("dist") == "loadfile" else None


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: WorkerController) -> None:
    """Called before a worker begins, in the process that hands out the files."""
    node.workerinput["nice"] = NICE if computes(node) else 0


def hands_out(config: pytest.Config) -> bool:
    """Whether this process runs no test, and gives them to workers."""
    return not hasattr(config, "workerinput") and getattr(config.option, "dist", "no") != "no"


def pytest_configure(config: pytest.Config) -> None:
    """Called in every process."""
    given = getattr(config, "workerinput", {}).get("nice", 0)
    if given and hasattr(os, "nice"):
        os.nice(given)
