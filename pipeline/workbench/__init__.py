"""From readings to a controller file in Python, a call a step, as the stages do it; for notebooks.

    data = screen("export.csv", pv="TIC-101.PV[degC]=0..120", mv="TIC-101.OP[%]=0..100", sp="TIC-101.SP")
    found = identify(data)
    controller = export(design("predictive", found), "predictive.onnx")
    run = simulate(controller, found.plant, {0: 60.0, 600: 70.0}, duration_s=3600)
    run.draw("loop.png")

Nothing here needs params.yaml, DVC or MLflow. The tests of many closed loops, and their verdict, are those of
``loopwright run``.
"""

from loopwright.pipeline.workbench.closed_loop import Run, design, export, simulate
from loopwright.pipeline.workbench.identification import Identification, identify
from loopwright.pipeline.workbench.plant_data import PlantData, experiment, screen

__all__ = ["Identification", "PlantData", "Run", "design", "experiment", "export", "identify", "screen", "simulate"]
