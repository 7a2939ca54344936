"""A loop on a made-up plant: ``python control_loop.py FILE.onnx [SCANS [PERIOD_S]]``; put yours into read and write."""

import sys

import numpy as np

from loopwright.serving import Controller, ControlLoop, Mode, MonotonicClock, Sample


class Plant:
    def __init__(self, manifest):
        self.m, self.k = manifest, 0
        self.mv = np.array([s.middle for s in manifest.mv])  # where its actuators stand

    def read(self):
        """Here the PVs wander over their ranges, and the MV is read back as it was written."""
        at, self.k = self.k % 10 / 10, self.k + 1
        pv = np.array([s.low + at * (s.high - s.low) for s in self.m.pv])
        return Sample(pv=pv, dv=np.array([s.middle for s in self.m.dv]), mv_applied=self.mv)

    def write(self, mv):
        self.mv = mv


def show(sample, command):
    print(command.scan, command.mode, *(command.mv.tolist() if command.writes else "-"), command.fault)


if not sys.argv[1:]:
    sys.exit("usage: python control_loop.py FILE.onnx [SCANS [PERIOD_S]]")
controller = Controller(sys.argv[1])
m = controller.manifest
scans = int(sys.argv[2]) if sys.argv[2:] else 20
clock = MonotonicClock(m.period_s / float(sys.argv[3]) if sys.argv[3:] else 1.0)  # a loop in another time than its own
sp = [s.middle for s in m.sp]  # yours
# No MV is given, so the loop writes none until the plant has been read, and begins from the read-back.
loop = ControlLoop(controller, Plant(m), sp=sp, mode=Mode.AUTO, recover_after=5, clock=clock)
print(loop.run(scans, observe=show))
