"""A controller in ten lines: ``python python_runtime.py FILE.onnx`` (numpy, onnxruntime and this package)."""

import sys

from loopwright.serving import Controller

controller = Controller(sys.argv[1] if sys.argv[1:] else sys.exit("usage: python python_runtime.py FILE.onnx"))
m, state = controller.manifest, controller.cold_state()  # zeros: no past
mv = [s.low for s in m.mv]  # stands for your read-back: where the actuators are
for k in range(100):  # once every m.period_s seconds
    sp, dv = ([(s.low + s.high) / 2 for s in of] for of in (m.sp, m.dv))  # your set points and measured disturbances
    pv = [s.low + (s.high - s.low) * (k % 10) / 10 for s in m.pv]  # your measurements
    mv, state, info = controller.step(sp=sp, pv=pv, dv=dv, mv_applied=mv, state=state)
    print(mv.tolist(), dict(zip(m.info, info.tolist(), strict=True)))  # to your actuators
