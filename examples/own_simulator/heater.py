"""A simulator of one's own, for `loopwright new heater --simulator heater.py`: a heated tank with a cold feed.

    C dT/dt = P(valve 20 s ago) - F c (T - T_feed) - k (T - T_room),    T_probe 15 s behind T

Any code may stand in ``step``, as long as all that the plant remembers is in the state: here the tank's
temperature, the probe's, and the valve's last two positions, which are the dead time.
"""

from __future__ import annotations


class Heater:
    period_s = 10.0
    pv = {"T": ("degC", 20, 95)}  # name: (unit, lowest, highest); the first are controlled
    mv = {"valve": ("%", 0, 100)}
    dv = {"feed": ("kg/h", 700, 1100)}  # measured disturbances; leave it out where there are none
    noise = {"T": 0.1}  # standard deviation of the measurement

    def start(self):
        """A rest: state, MVs, measured disturbances."""
        tank = self.rest(valve=45.0, feed=900.0)
        return [tank, tank, 45.0, 45.0], [45.0], [900.0]

    def step(self, x, mv, dv):
        """The state one period later, with the MVs and disturbances held over the period."""
        tank, probe, older, newer = x
        for _ in range(5):
            gain = self.heat(older) - dv[0] / 3600 * 4180 * (tank - 15) - 300 * (tank - 20)
            tank, probe = tank + 2.0 * gain / 9e5, probe + 2.0 * (tank - probe) / 15
        return [tank, probe, newer, mv[0]]

    def measure(self, x):
        """The process variables."""
        return [x[1]]

    @staticmethod
    def heat(valve):
        return 110e3 * (valve / 100) ** 1.4

    def rest(self, valve, feed):
        flow = feed / 3600 * 4180
        return (self.heat(valve) + flow * 15 + 300 * 20) / (flow + 300)
