"""The scans counted on the server's side, so that the plant knows that its loop lives."""

from __future__ import annotations

from loopwright.serving.errors import EndpointError
from loopwright.serving.opcua.link import Link
from loopwright.serving.opcua.plan import NodePlan
from loopwright.serving.opcua.values import STATUS_GOOD, variant, words
from loopwright.serving.words import first_line


class Heartbeat:
    """Counts while there are scans. A plant that gets no count must not be written: ``trouble`` says why."""

    def __init__(self) -> None:
        self.trouble = ""
        self._beats = 0  # scans that were counted

    async def beat(self, link: Link, plan: NodePlan, scans: int, answer_s: float) -> None:
        """Write how many ``scans`` there were, if there are new ones.

        A node that has another type now is counted in that one from the next scan on.
        """
        if plan.heartbeat is None or scans == self._beats:
            return
        self._beats = scans
        node, kind, most = plan.heartbeat
        try:
            count = variant(float(scans % most), kind, 0.0, float(most))
        except EndpointError as error:
            self.trouble = f"heartbeat: {first_line(error)}"
        else:
            (status,) = await link.write([(node, count)], answer_s)
            self.trouble = "" if status >> 30 == STATUS_GOOD else f"the server refuses heartbeat: {words(status)}"
        if self.trouble:
            (now,) = await link.read([node], answer_s)
            if now.kind is not None:
                plan.beat_in(node, now.kind)
