"""A loop on a plant over months, in minutes: memory, lateness, and a page under attack beside it.

``python benchmarks/plant_loop.py scans [--scans 1000000]``: at full speed, each written down, on a plant in memory.
``python benchmarks/plant_loop.py day [--hours 24]``: so much of a plant's time over OPC UA, as fast as it goes.
``python benchmarks/plant_loop.py timing [--minutes 5] [--attack]``: a loop of 100 ms over OPC UA with the page open,
and with ``--attack`` slow connections, malformed requests and forged changes against it meanwhile.

Memory counts from a minute after the start on (of ``scans``: from a tenth on). The plant's server, the page and whoever
loads the page are processes of their own.
"""

from __future__ import annotations

import argparse
import contextlib
import http.client
import json
import random
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from loopwright.serving import (
    Command,
    Controller,
    ControlLoop,
    Mode,
    MonotonicClock,
    Sample,
    SimulatedEndpoint,
    VirtualClock,
)
from loopwright.serving.journal import Journal
from loopwright.serving.opcua.settings import Nodes, Point, Server
from loopwright.serving.station.recorder import Recorder
from loopwright.serving.station.settings import JournalSettings, Settings
from loopwright.serving.station.station import Station

ROOT = Path(__file__).parents[1]
FILE = ROOT / "artifacts" / "henson_seborg_cstr" / "predictive.onnx"
PERIOD_S = 0.1
SPACE = "nsu=urn:loopwright:plant;s="


class Watched:
    """Memory of this process over time, and what each scan took."""

    def __init__(self, scans: int = 0) -> None:
        # Room for all scans is taken before the first one, so that it does not count as growth.
        self._late, self._whole, self.seen = np.ones(scans), np.ones(scans), 0
        self.memory = list[tuple[float, float]]()
        self.began = time.monotonic()

    def note(self, late: float, whole: float) -> None:
        """Note how late a scan was and when it was over, in seconds after it was due."""
        if self.seen < len(self._late):
            self._late[self.seen], self._whole[self.seen] = late, whole
            self.seen += 1

    @property
    def late(self) -> np.ndarray:
        """Lateness of each scan [s]."""
        return self._late[: self.seen]

    @property
    def whole(self) -> np.ndarray:
        """From when each scan was due to its end [s]."""
        return self._whole[: self.seen]

    def look(self) -> None:
        """Note the present memory, in MB."""
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        self.memory.append((time.monotonic() - self.began, pages * 4096 / 1e6))

    def grown(self, after_s: float) -> str:
        """By how much memory grew since a time: up to the greatest and the last."""
        later = [mb for at, mb in self.memory if at >= after_s] or [self.memory[-1][1]]
        most, last, half = max(later) - later[0], later[-1] - later[0], later[-1] - later[len(later) // 2]
        return (
            f"memory: {later[0]:.1f} MB after {after_s:.0f} s; since then at most {most:+.1f}, at the end {last:+.1f}, "
            f"of which {half:+.1f} in the second half"
        )


class TimedClock(MonotonicClock):
    """The machine's clock, which notes how late it woke."""

    def __init__(self, speed: float, watched: Watched) -> None:
        super().__init__(speed)
        self.watched, self.due = watched, 0.0

    def sleep_until(self, time_s: float) -> None:
        """Sleep, and note how late."""
        super().sleep_until(time_s)
        self.due = time_s
        self.late = (self.now() - time_s) / self.speed


def shares(values: np.ndarray) -> str:
    """p50, p99, p99.9 and the worst, in milliseconds."""
    p = 1e3 * np.percentile(values, [50, 99, 99.9, 100])
    return f"p50 {p[0]:.2f}, p99 {p[1]:.2f}, p99.9 {p[2]:.2f}, worst {p[3]:.2f} ms"


def scans(n: int, folder: Path) -> None:
    """Full speed on a plant in memory."""
    controller = Controller(FILE)
    m, watched, rng = controller.manifest, Watched(), np.random.default_rng(0)
    middle = np.array([s.middle for s in m.pv])
    state = middle.copy()

    def step(mv: np.ndarray) -> np.ndarray:
        state[:] = middle + 0.9 * (state - middle) + 0.01 * middle * rng.normal(size=len(middle))
        return state

    journal = Journal(folder / "loop.journal", max_mb=100)
    recorder = Recorder(journal, lambda _: None)
    recorder.begin(controller)
    endpoint = SimulatedEndpoint(step, pv=middle, mv=[s.middle for s in m.mv])
    loop = ControlLoop(
        controller, endpoint, sp=[s.middle for s in m.sp], mv=[s.middle for s in m.mv], mode=Mode.AUTO,
        clock=VirtualClock(), warm_lead_s=0,
    )  # fmt: skip

    def observe(sample: Sample | None, command: Command) -> None:
        recorder.scan(loop, sample, command)
        if command.scan % max(n // 100, 1) == 0:
            watched.look()
        if journal.behind > 20_000:  # as a plant gives a loop time, so does this
            while journal.behind:
                time.sleep(0.01)

    law_s = _law_alone(controller)
    watched.began = time.monotonic()
    report = loop.run(n, observe=observe)
    taken = time.monotonic() - watched.began
    watched.look()
    journal.close()
    size = (folder / "loop.journal").stat().st_size
    print(
        f"{report.scans} scans in {taken:.0f} s, {1e6 * taken / n:.0f} us each with the journal, "
        f"of which the law alone takes {1e6 * law_s:.0f}; "
        f"{report.faults} faults; {journal.lost} rows lost; the journal has {size / 1e6:.1f} MB"
    )
    print(watched.grown(taken / 10))


def _law_alone(controller: Controller) -> float:
    """What a step takes [s], the median: it is most of a scan, and differs from machine to machine."""
    m, state = controller.manifest, controller.cold_state()
    sp, pv, mv = (np.array([s.middle for s in signals]) for signals in (m.sp, m.pv, m.mv))
    taken = list[float]()
    for _ in range(2_000):
        began = time.perf_counter()
        step = controller.step(sp=sp, pv=pv, mv_applied=mv, state=state)
        taken.append(time.perf_counter() - began)
        mv, state = step.mv, step.state
    return float(np.median(taken))


@contextlib.contextmanager
def station(folder: Path, speed: float, page: str, watched: Watched) -> Iterator[Station]:
    """A loop on a served plant, in AUTO; the plant is a process of its own."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port = s.getsockname()[1]
    serve = [
        sys.executable,
        "-m",
        "loopwright.pipeline",
        "plant",
        "serve",
        FILE.parent.name,
        "--noise",
        "--folder",
        str(folder / "server"),
    ]
    serve += ["--listen", f"127.0.0.1:{port}", "--speed", f"{speed:g}"]
    process = subprocess.Popen(serve, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    process.stdout.readline()
    m = Controller(FILE).manifest
    settings = Settings(
        controller=FILE,
        server=Server(f"opc.tcp://127.0.0.1:{port}", security="None", insecure=True),
        nodes=Nodes(
            pv={s.name: f"{SPACE}PV.{s.name}" for s in m.pv},
            mv={s.name: Point(f"{SPACE}MV.{s.name}", read_back=f"{SPACE}RB.{s.name}") for s in m.mv},
            heartbeat=f"{SPACE}Control.Heartbeat",
            watchdog=f"{SPACE}Control.Watchdog",
            watchdog_scans=10,
        ),
        start="AUTO",
        speed=speed,
        journal=JournalSettings(folder / "loop.journal", max_mb=200),
        page=page,
    )
    settings = replace(settings, guards=replace(settings.guards, max_age_s=5 * m.period_s))
    made = Station(settings, tell=lambda line: print(f"  {line}", flush=True))
    clock = TimedClock(speed, watched)
    made.clock = clock

    def seen(_: Sample | None, command: Command) -> None:
        watched.note(clock.late, (clock.now() - clock.due) / speed)
        if command.scan % 200 == 0:
            watched.look()

    made.watch(seen)
    try:
        yield made
    finally:
        process.kill()
        process.wait()


def day(hours: float, speed: float, folder: Path) -> None:
    """A plant's day over OPC UA."""
    scans = round(hours * 3600 / Controller(FILE).manifest.period_s)
    watched = Watched(scans)
    with station(folder, speed, "", watched) as made:
        report = made.run(scans)
    taken = time.monotonic() - watched.began
    print(f"{hours:g} h of the plant in {taken:.0f} s: {report.scans} scans, {report.missed} periods missed, "
          f"{report.faults} scans with a fault, {1e3 * taken / scans:.2f} ms a period")  # fmt: skip
    print(watched.grown(60))


def timing(minutes: float, attack: bool, folder: Path) -> None:
    """100 ms with the page open."""
    scans = round(60 * minutes / PERIOD_S)
    watched = Watched(scans)
    with station(folder, Controller(FILE).manifest.period_s / PERIOD_S, "127.0.0.1:0", watched) as made:
        over = threading.Event()
        thread = threading.Thread(target=_load_beside, args=(made, attack, over), daemon=True)
        thread.start()
        report = made.run(scans)
        over.set()
        thread.join()
    late, whole = watched.late[20:], watched.whole[20:]
    print(
        f"{report.scans} scans of {1e3 * PERIOD_S:.0f} ms, {report.missed} periods missed, {report.faults} with a fault"
    )
    print(f"lateness: {shares(late)}")
    print(f"whole scan, from when it was due: {shares(whole)}")
    print(watched.grown(60))


def _load_beside(made: Station, attack: bool, over: threading.Event) -> None:
    while made.page is None or made.scans < 10:
        time.sleep(0.1)
    port = int(made.page.url.rpartition(":")[2])
    command = [sys.executable, __file__, "load", str(port), made.page.token, *(["--attack"] if attack else [])]
    with subprocess.Popen(command, cwd=ROOT) as load:
        while load.poll() is None and not over.wait(0.2):
            pass
        load.kill()


def load(port: int, attack: bool) -> None:
    """What several open pages ask for; with ``attack`` also what no page would."""
    for _ in range(3):
        threading.Thread(target=_listen, args=(port,), daemon=True).start()
    if attack:
        threading.Thread(target=_slow, args=(port,), daemon=True).start()
        threading.Thread(target=_fuzz, args=(port,), daemon=True).start()
    counts = dict[str, int]()
    while True:
        now = time.time()
        for path in (f"/api/trend?from={now - 3600}&to={now}&points=1000", "/api/events", "/api/state", "/metrics"):
            try:
                wire = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
                wire.request("GET", path)
                wire.getresponse().read()
                wire.close()
            except OSError as error:
                counts[type(error).__name__] = counts.get(type(error).__name__, 0) + 1
        time.sleep(1)


def _listen(port: int) -> None:
    while True:
        with contextlib.suppress(OSError):
            wire = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
            wire.request("GET", "/api/live")
            stream = wire.getresponse()
            while stream.readline():
                pass
        time.sleep(1)


def _slow(port: int) -> None:
    """Slow-loris: many connections, a byte a second each."""
    wires = list[socket.socket]()
    while True:
        while len(wires) < 300:
            try:
                wire = socket.create_connection(("127.0.0.1", port), timeout=2)
                wire.sendall(b"GET / HTTP/1.1\r\nX-")
                wires.append(wire)
            except OSError:
                break
        for wire in list(wires):
            try:
                wire.sendall(b"a")
            except OSError:
                wires.remove(wire)
                wire.close()
        time.sleep(1)


def _fuzz(port: int) -> None:
    """Requests for a change: forged, cross-site, malformed, oversized; 10,000, then again."""
    rng, count, accepted = random.Random(0), 0, 0
    most = 10_000
    body = json.dumps({"do": "mode", "value": "MANUAL", "who": "x"}).encode()
    while True:
        host = rng.choice([f"127.0.0.1:{port}", "evil.example", f"localhost:{port}"])
        origin = rng.choice([f"http://127.0.0.1:{port}", "https://evil.example", "null"])
        head = (
            f"POST /api/change HTTP/1.1\r\nHost: {host}\r\nOrigin: {origin}\r\nContent-Type: application/json\r\n"
            f"Authorization: Bearer {rng.randbytes(12).hex()}\r\n"
            f"Content-Length: {rng.choice([len(body), 99999999, -1])}\r\n\r\n"
        ).encode()
        data = bytearray(head + body + rng.choice([b"", b"A" * 50_000]))
        for _ in range(rng.choice([0, 0, 1, 5])):
            data[rng.randrange(len(head))] = rng.randrange(256)
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=2) as wire:
            wire.sendall(data)
            wire.shutdown(socket.SHUT_WR)
            accepted += wire.recv(100).startswith(b"HTTP/1.1 200")
        count += 1
        if count == most:
            most *= 3
            print(f"  {count} malformed or forged requests, {accepted} accepted", flush=True)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_subparsers(dest="what", required=True)
    full = what.add_parser("scans")
    full.add_argument("--scans", type=int, default=1_000_000)
    long = what.add_parser("day")
    long.add_argument("--hours", type=float, default=24)
    long.add_argument("--speed", type=float, default=100, help="of the plant beside the clock (%(default)s)")
    page = what.add_parser("timing")
    page.add_argument("--minutes", type=float, default=5)
    page.add_argument("--attack", action="store_true")
    loading = what.add_parser("load")
    loading.add_argument("port", type=int)
    loading.add_argument("token")
    loading.add_argument("--attack", action="store_true")
    options = parser.parse_args()
    if options.what == "load":
        load(options.port, options.attack)
    with tempfile.TemporaryDirectory() as folder:
        if options.what == "scans":
            scans(options.scans, Path(folder))
        elif options.what == "day":
            day(options.hours, options.speed, Path(folder))
        else:
            timing(options.minutes, options.attack, Path(folder))


if __name__ == "__main__":
    main()
