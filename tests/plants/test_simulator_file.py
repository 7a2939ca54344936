"""A simulator in a file of one's own: it is a plant like the others, and each mistake in it is one line."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.plants.simulator_file import NOISE_SHARE, FileSimulator

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_simulator" / "heater.py"
LAG = """
class Lag:
    period_s = 2.0
    pv = {"y": ("K", -5, 5)}
    mv = {"u": ("%", 0, 10)}
    def start(self):
        return [1.0], [5.0]
    def step(self, x, mv, dv):
        return [0.8 * x[0] + 0.04 * mv[0]]
    def measure(self, x):
        return [x[0]]
"""


def plant(folder: Path, text: str = LAG, every: int = 1) -> FileSimulator:
    path = folder / "lag.py"
    path.write_text(text)
    return FileSimulator(path, every=every)


def test_the_example_is_a_plant_at_rest_that_survives_pickling() -> None:
    heater = FileSimulator(EXAMPLE, "heater")
    (x, mv), dv, p = heater.start, heater.dv_nominal, heater.parameters()
    assert (heater.name, heater.period_s, heater.noise_std.tolist()) == ("heater", 10.0, [0.1])
    assert [s.name for s in (*heater.pv_signals, *heater.mv_signals, *heater.dv_signals)] == ["T", "valve", "feed"]
    np.testing.assert_allclose(heater.step(x, mv, dv, p), x)
    again = pickle.loads(pickle.dumps(heater))
    np.testing.assert_array_equal(again.step(x, mv + 5, dv, p), heater.step(x, mv + 5, dv, p))


def test_a_period_of_several_steps_holds_the_mv(tmp_path: Path) -> None:
    one, three = plant(tmp_path), plant(tmp_path, every=3)
    x, mv, p = one.start[0], np.array([8.0]), one.parameters()
    for _ in range(3):
        x = one.step(x, mv, np.zeros(0), p)
    assert three.period_s == 6.0
    np.testing.assert_allclose(three.step(one.start[0], mv, np.zeros(0), p), x)


def test_a_load_acts_behind_the_controller_within_the_range(tmp_path: Path) -> None:
    lag = plant(tmp_path)
    x, dv = lag.start[0], np.zeros(0)
    loaded = lag.step(x, np.array([5.0]), dv, lag.parameters({"load_u": 2.0}))
    np.testing.assert_allclose(loaded, lag.step(x, np.array([7.0]), dv, lag.parameters()))
    full = lag.step(x, np.array([9.0]), dv, lag.parameters({"load_u": 50.0}))
    np.testing.assert_allclose(full, lag.step(x, np.array([10.0]), dv, lag.parameters()))
    assert lag.parameter_units() == {"load_u": "%"}
    assert lag.noise_std == pytest.approx([10 * NOISE_SHARE])
    with pytest.raises(PlantError, match="no parameter 'load_x'; it has load_u"):
        lag.parameters({"load_x": 1.0})


MISTAKES = {
    "no class": ("x = 1", "has no class"),
    "two classes": (LAG + LAG.replace("Lag", "Log"), "has Lag, Log"),
    "a syntax error": (LAG + "\n)", "cannot be loaded: SyntaxError"),
    "no period": (LAG.replace("period_s = 2.0", ""), "period_s is None"),
    "no MV": (LAG.replace('"u": ("%", 0, 10)', ""), "mv is empty"),
    "a range upside down": (LAG.replace("0, 10", "10, 0"), "low < high"),
    "a signal without a unit": (LAG.replace('("%", 0, 10)', "(0, 10)"), "'u' has (0, 10)"),
    "a name with a blank": (LAG.replace('"u"', '"my u"'), "name 'my u'"),
    "a start outside": (LAG.replace("[5.0]", "[50.0]"), "u = 50, outside its range 0 to 10"),
    "a start without MV": (LAG.replace("[1.0], [5.0]", "[1.0]"), "start() must return x, mv"),
    "noise of another name": (LAG.replace("period_s", 'noise = {"z": 1}\n    period_s'), "noise names 'z'"),
    "a state of another length": (LAG.replace("[0.8", "[1, 0.8"), "step gave shape (2,); (1,) is wanted"),
    "text as a PV": (LAG.replace("return [x[0]]", "return ['a']"), "measure gave ['a']"),
    "an error in step": (LAG.replace("0.04 * mv[0]", "1 / 0"), "line 9, step(): ZeroDivisionError"),
    "a memory of its own": (
        LAG.replace("return [0.8", "self.n = getattr(self, 'n', 0) + 1\n        return [self.n + 0.8"),
        "keeps something of its own",
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_one_line_with_its_place(name: str, tmp_path: Path) -> None:
    text, says = MISTAKES[name]
    with pytest.raises(PlantError) as error:
        plant(tmp_path, text)
    assert says in str(error.value)
    assert str(error.value).startswith(str(tmp_path / "lag.py"))
    assert "\n" not in str(error.value)
