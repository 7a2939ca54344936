"""A simulated plant behind a real OPC UA server, with faults on request: for trying a loop before a plant has it."""

from __future__ import annotations

import asyncio
import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from asyncua import Client, Server, ua
from asyncua.crypto.cert_gen import setup_self_signed_certificate
from asyncua.crypto.truststore import TrustStore
from asyncua.crypto.validator import CertificateValidator, CertificateValidatorOptions
from cryptography.x509.oid import ExtendedKeyUsageOID

from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.plants.equations import EquationPlant, rk4_step
from loopwright.pipeline.plants.simulator import Advance, Array, Simulator
from loopwright.serving.manifest import Signal

NAMESPACE = "urn:loopwright:plant"
APPLICATION = "urn:loopwright:plant:server"
LOCAL, REMOTE = 0, 1  # who has the plant: its own controller, or whoever writes the MVs
LEASE = "LoopwrightLease"  # its browse name, by which loops find it beside the MVs
ALIVE_PERIODS = 3  # periods without a heartbeat after which a loop counts as gone
WATCHDOG = "Control.Watchdog"
PERIOD_PARTS, LEAST_PART_S = 10, 0.025  # a period has so many parts at most, each at least as long by the clock
KINDS = {"LREAL": ua.VariantType.Double, "REAL": ua.VariantType.Float}


@dataclass
class PlantServer:
    """One plant, ``speed`` times as fast as the clock.

    A plant of differential equations moves on, takes its MVs and shows its PVs several times a period, as a real one
    does without end: when a loop asks does not matter then. Any other one moves once a period.

    Nodes ``PV.x``, ``MV.x`` (written by whoever controls), ``RB.x`` (the MV that the actuator has), ``DV.x``, ``SP.x``,
    each with its unit and range; ``Control.Owner`` (0 its own controller, which holds the MVs; 1 the loop),
    ``Control.Mode`` (for an operator: 0 MANUAL, 1 AUTO, 2 SHADOW), ``Control.Watchdog`` (counts periods),
    ``Control.Heartbeat`` (for the loop to count), ``Control.LoopAlive``, ``Control.Lease``; and ``Faults.x`` for every
    PV, MV and DV, which takes one of FAULTS, ``Faults.Control.Watchdog``, which takes "frozen", and ``Faults.Clock``,
    by how many seconds the source times are off.
    """

    plant: Simulator
    endpoint: str
    x: Array
    mv: Array
    noise_std: Array | None = None  # shape: (n_pv,)
    seed: int = 0
    speed: float = 1.0
    types: str = "LREAL"
    folder: Path = Path("plant-server")  # of its certificate, and of trusted ones
    trust_all: bool = True
    tell: Callable[[str], object] = lambda _: None
    log: Path | None = (
        None  # a line of JSON each period: what the MV nodes hold, the actuator has; the loop's heartbeat
    )

    def __post_init__(self) -> None:
        self.server = Server()
        self.k = 0
        self._rng = np.random.default_rng(self.seed)
        self._beat: tuple[Any, int] = (None, 0)
        self._frozen: dict[str, tuple[float, datetime]] = {}
        self._kinds: dict[str, ua.VariantType] = {}
        self._gone: set[str] = set()
        self._kind = KINDS[self.types]
        self.parts, self._advance = in_parts(self.plant, self.plant.period_s / self.speed)
        self._out = None if self.log is None else self.log.open("a", encoding="utf-8", buffering=1)

    async def run(self, periods: int | None = None) -> None:
        """Serve until cancelled, or for some periods."""
        await self._prepare()
        async with self.server:
            self.tell(f"serving {self.plant.name} at {self.endpoint}")
            start = time.monotonic()
            part_s = self.plant.period_s / self.speed / self.parts
            while periods is None or self.k < periods:
                for part in range(self.parts):
                    await self._part(first=part == 0)
                    # On a grid; a machine that is late catches up.
                    due = start + (self.k * self.parts + part + 1) * part_s
                    await asyncio.sleep(max(0.0, due - time.monotonic()))
                self.k += 1

    # ------------------------------------------------------------------ address space
    async def _prepare(self) -> None:
        server = self.server
        await server.init()
        server.set_endpoint(self.endpoint)
        server.set_server_name(f"Loopwright: {self.plant.title}")
        await server.set_application_uri(APPLICATION)
        await self._secure()
        self.index = await server.register_namespace(NAMESPACE)
        objects = server.get_objects_node()
        self.root = await objects.add_object(self._id("Plant"), f"{self.index}:Plant")
        self.start = {
            **{f"PV.{s.name}": v for s, v in zip(self.plant.pv_signals, self._measured(), strict=True)},
            **{f"MV.{s.name}": v for s, v in zip(self.plant.mv_signals, self.mv, strict=True)},
            **{f"RB.{s.name}": v for s, v in zip(self.plant.mv_signals, self.mv, strict=True)},
            **{f"DV.{s.name}": v for s, v in zip(self.plant.dv_signals, self.plant.dv_nominal, strict=True)},
            **{f"SP.{s.name}": v for s, v in zip(self.plant.sp_signals, self._measured(), strict=False)},
        }
        for tag in self.start:
            await self._variable(tag)
        control = {"Owner": REMOTE, "Watchdog": 0, "Heartbeat": 0, "Mode": 2}
        for name, value in control.items():
            node = await self.root.add_variable(
                self._id(f"Control.{name}"), f"{self.index}:{name}", ua.Variant(value, ua.VariantType.Int32)
            )
            await node.set_writable(name != "Watchdog")
        for name, shown, start in (("LoopAlive", "LoopAlive", False), ("Lease", LEASE, "")):
            node = await self.root.add_variable(self._id(f"Control.{name}"), f"{self.index}:{shown}", start)
            await node.set_writable(name == "Lease")
        for tag in (*self.start, WATCHDOG):
            node = await self.root.add_variable(self._id(f"Faults.{tag}"), f"{self.index}:Faults.{tag}", "")
            await node.set_writable()
        node = await self.root.add_variable(self._id("Faults.Clock"), f"{self.index}:Faults.Clock", 0.0)
        await node.set_writable()

    async def _variable(self, tag: str, value: ua.Variant | None = None) -> None:
        group, _, name = tag.partition(".")
        value = value or ua.Variant(float(self.start[tag]), self._kind)
        node = await self.root.add_variable(self._id(tag), f"{self.index}:{tag}", value)
        self._kinds[tag] = value.VariantType
        await node.set_writable(group in {"MV", "SP", "DV"})
        signal = self._signal(group, name)
        unit = ua.EUInformation(DisplayName=ua.LocalizedText(signal.unit))
        await node.add_property(self.index, "EngineeringUnits", unit)
        await node.add_property(self.index, "EURange", ua.Range(Low=signal.low, High=signal.high))

    def _signal(self, group: str, name: str) -> Signal:
        p = self.plant
        of = {"PV": p.pv_signals, "MV": p.mv_signals, "RB": p.mv_signals, "DV": p.dv_signals, "SP": p.sp_signals}
        return next(s for s in of[group] if s.name == name)

    def _id(self, tag: str) -> ua.NodeId:
        return ua.NodeId(ua.String(tag), ua.Int16(self.index))

    async def _secure(self) -> None:
        """Both None and Basic256Sha256, so that either can be tried; a certificate of its own, made once."""
        self.folder.mkdir(parents=True, exist_ok=True)
        trusted = self.folder / "trusted"
        trusted.mkdir(exist_ok=True)
        key, certificate = self.folder / "key.pem", self.folder / "certificate.der"
        host = self.endpoint.removeprefix("opc.tcp://").partition(":")[0]
        await setup_self_signed_certificate(
            key, certificate, APPLICATION, host, [ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH], {}
        )
        key.chmod(0o600)
        await self.server.load_certificate(str(certificate))
        await self.server.load_private_key(str(key))
        policies = [ua.SecurityPolicyType.NoSecurity, ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt]
        if not self.trust_all:
            policies = policies[1:]
            # A store of asyncua is never empty: the server trusts itself.
            (trusted / "this-server.der").write_bytes(certificate.read_bytes())
            store = TrustStore([trusted], [])
            await store.load()
            self.server.set_certificate_validator(
                CertificateValidator(CertificateValidatorOptions.TRUSTED_VALIDATION, store)
            )
        self.server.set_security_policy(policies)

    # ------------------------------------------------------------------ a period
    async def _part(self, first: bool) -> None:
        """Take the MVs, advance the plant, publish; with the first part of a period also what counts periods."""
        p = self.plant
        asked = np.array([await self._number(f"MV.{s.name}", v) for s, v in self._with(p.mv_signals, self.mv)])
        dv = np.array([await self._number(f"DV.{s.name}", v) for s, v in self._with(p.dv_signals, p.dv_nominal)])
        if await self._value("Control.Owner") == REMOTE:
            low, high = (np.array([getattr(s, end) for s in self.plant.mv_signals]) for end in ("low", "high"))
            self.mv = np.clip(asked, low, high)
        self.x = self._advance(self.x, self.mv, dv, p.parameters())
        if not np.isfinite(self.x).all():
            raise PlantError(f"{self.plant.name} has left what it can compute, with MVs {self.mv.tolist()}")
        await self._publish()
        if first:
            beat, alive = await self._count()
            if self._out is not None:
                row = {"k": self.k, "time": time.time(), "asked": asked.tolist(), "mv": self.mv.tolist()}
                self._out.write(json.dumps({**row, "beat": beat, "alive": alive}) + "\n")

    async def _publish(self) -> None:
        now = datetime.now(UTC) + timedelta(seconds=float(await self._value("Faults.Clock")))
        for s, value in self._with(self.plant.pv_signals, self._measured()):
            await self._show(f"PV.{s.name}", float(value), now)
        for s, value in self._with(self.plant.mv_signals, self.mv):
            await self._show(f"RB.{s.name}", float(value), now)
        for s in (*self.plant.mv_signals, *self.plant.dv_signals, *self.plant.sp_signals):
            for group in ("MV", "DV", "SP"):
                if f"{group}.{s.name}" in self.start:
                    await self._spoil_alone(f"{group}.{s.name}")

    async def _count(self) -> tuple[Any, bool]:
        """Show that the server lives, and see whether the loop does: its heartbeat, and whether it counts as alive."""
        if await self._value(f"Faults.{WATCHDOG}") != "frozen":
            await self._set(WATCHDOG, ua.Variant(self.k % 30_000, ua.VariantType.Int32))
        beat = await self._value("Control.Heartbeat")
        last, age = self._beat
        self._beat = (beat, 0 if beat != last else age + 1)
        alive = self._beat[1] < ALIVE_PERIODS
        await self._set("Control.LoopAlive", ua.Variant(alive, ua.VariantType.Boolean))
        return beat, alive

    async def _show(self, tag: str, value: float, now: datetime) -> None:
        """Publish a value, as its fault has it."""
        fault = await self._fault(tag)
        if fault == "frozen":
            value, now = self._frozen.setdefault(tag, (value, now))
        else:
            self._frozen.pop(tag, None)
        if tag in self._gone:
            return
        status = {"bad": ua.StatusCodes.BadSensorFailure, "uncertain": ua.StatusCodes.UncertainSensorNotAccurate}
        variant = {
            "text": ua.Variant("####", ua.VariantType.String),
            "int": ua.Variant(round(value), ua.VariantType.Int32),
            "nan": ua.Variant(float("nan"), self._kind),
        }.get(fault, ua.Variant(value, self._kind))
        await self._typed(tag, variant)
        code = ua.StatusCode(status.get(fault, ua.StatusCodes.Good))
        await self.server.write_attribute_value(self._id(tag), ua.DataValue(variant, code, SourceTimestamp=now))

    async def _spoil_alone(self, tag: str) -> None:
        """Whether a node that others write is there, and its type."""
        fault = await self._fault(tag)
        if tag not in self._gone:
            value = float(await self._value(tag))
            whole = ua.Variant(round(value), ua.VariantType.Int32)
            await self._typed(tag, whole if fault == "int" else ua.Variant(value, self._kind))

    async def _typed(self, tag: str, value: ua.Variant) -> None:
        """Make a node anew where it is to be of another type: a server changes none."""
        if self._kinds[tag] is not value.VariantType:
            await self.server.delete_nodes([self.server.get_node(self._id(tag))])
            await self._variable(tag, value)

    async def _fault(self, tag: str) -> str:
        """The fault that is asked for; a node goes and comes with ``deleted``."""
        fault = str(await self._value(f"Faults.{tag}"))
        if fault == "deleted" and tag not in self._gone:
            self._gone.add(tag)
            await self.server.delete_nodes([self.server.get_node(self._id(tag))])
        elif fault != "deleted" and tag in self._gone:
            self._gone.discard(tag)
            await self._variable(tag)
        return fault

    # ------------------------------------------------------------------ small things
    def _measured(self) -> Array:
        pv = self.plant.measure(self.x)
        return pv if self.noise_std is None else pv + self.noise_std * self._rng.standard_normal(len(pv))

    @staticmethod
    def _with(signals: tuple[Signal, ...], values: Array) -> list[tuple[Signal, float]]:
        return list(zip(signals, values.tolist(), strict=True))

    async def _value(self, tag: str) -> Any:
        return self.server.read_attribute_value(self._id(tag)).Value.Value

    async def _number(self, tag: str, otherwise: float) -> float:
        """A node's number; what it was where the node is gone or holds none."""
        if tag in self._gone:
            return otherwise
        value = await self._value(tag)
        return float(value) if isinstance(value, int | float) and np.isfinite(value) else otherwise

    async def _set(self, tag: str, value: ua.Variant) -> None:
        await self.server.write_attribute_value(self._id(tag), ua.DataValue(value))


def in_parts(plant: Simulator, period_s: float) -> tuple[int, Advance]:
    """In how many parts a plant goes through a period of ``period_s`` by the clock, and its step over one of them."""
    n = min(PERIOD_PARTS, int(period_s / LEAST_PART_S))
    if not isinstance(plant, EquationPlant) or n < 2:
        return 1, plant.step
    steps = math.ceil(plant.substeps / n)
    h = plant.period_s / plant.time_unit_s / n / steps
    x, mv, dv, p = (ca.SX.sym(name, plant.rate.numel_in(i)) for i, name in enumerate(("x", "mv", "dv", "p")))
    state = x
    for _ in range(steps):
        state = rk4_step(lambda at: plant.rate(at, mv, dv, p), state, h)
    transition = ca.Function("part", [x, mv, dv, p], [ca.densify(state)])
    return n, lambda x, mv, dv, p: np.array(transition(x, mv, dv, p))[:, 0]


async def spoil(endpoint: str, tag: str, fault: str) -> None:
    """Give a signal of a served plant one of FAULTS. PlantError where no such plant answers, or it has no such tag."""
    try:
        async with Client(endpoint, timeout=5) as client:
            index = await client.get_namespace_index(NAMESPACE)
            node = client.get_node(ua.NodeId(ua.String(f"Faults.{tag}"), ua.Int16(index)))
            await node.read_value()  # a node that is not there would be refused as one that may not be written
            await node.write_value(fault)
    except ua.uaerrors.BadNodeIdUnknown:
        words = f"the plant at {endpoint} has no signal {tag!r}; write it as PV.NAME, RB.NAME, MV.NAME or DV.NAME"
        raise PlantError(words) from None
    except (OSError, TimeoutError) as error:
        words = f"no served plant answers at {endpoint} ({type(error).__name__}); `loopwright plant serve` starts one"
        raise PlantError(words) from None
    except ValueError:
        raise PlantError(f"the server at {endpoint} is no `loopwright plant serve`: it has no {NAMESPACE}") from None
    except ua.UaError as error:
        raise PlantError(f"the plant at {endpoint} refuses: {type(error).__name__}") from None
