"""What a host may import: the names of ``serving``, documented, and with the arguments that hosts rely on."""

from __future__ import annotations

import inspect

from loopwright import serving

SURFACE = {
    "Allowed", "ArtifactError", "Clock", "Command", "Complete", "ContractError", "ControlLoop", "Controller",
    "Endpoint", "EndpointError", "Fallback", "Fresh", "Frozen", "Guard", "InRange", "LoopError", "LoopwrightError",
    "Manifest", "Mode", "MonotonicClock", "OutputError", "Rate", "RunReport", "Sample", "SampleError", "Signal",
    "SignatureError", "SimulatedEndpoint", "Step", "VirtualClock", "default_guards",
}  # fmt: skip


def test_the_names_that_hosts_import_are_these() -> None:
    """A name that goes or comes is a decision of a release, not of a refactoring."""
    assert set(serving.__all__) == SURFACE
    assert all(hasattr(serving, name) for name in SURFACE)


def test_every_public_name_is_documented() -> None:
    for name in serving.__all__:
        value = getattr(serving, name)
        assert inspect.getdoc(value), name
        for member, function in inspect.getmembers(value, inspect.isfunction):
            if not member.startswith("_") and function.__module__.startswith("loopwright.serving"):
                assert inspect.getdoc(function), f"{name}.{member}"


def test_a_step_takes_and_gives_what_hosts_write_down() -> None:
    step = inspect.signature(serving.Controller.step).parameters
    assert set(step) == {"self", "sp", "pv", "dv", "mv_applied", "state", "operate", "fresh", "ahead"}
    assert all(step[p].kind is inspect.Parameter.KEYWORD_ONLY for p in step if p != "self")
    assert {"sp", "mv", "mode", "guards", "recover_after", "clock", "operate", "bridge_s", "critical"} <= set(
        inspect.signature(serving.ControlLoop.__init__).parameters
    )


def test_every_error_is_a_loopwright_error() -> None:
    errors = [getattr(serving, n) for n in serving.__all__ if n.endswith("Error")]
    assert all(issubclass(e, serving.LoopwrightError) for e in errors)
