"""Controller: load one .onnx file, check it, step it."""

from __future__ import annotations

import os
from contextlib import suppress
from math import inf, isfinite
from os import PathLike
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple, NoReturn, TypeAlias
from weakref import WeakSet

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopwright.serving.controller_file import DIGEST_KEY, file_digest, law_digest, read_controller
from loopwright.serving.errors import ArtifactError, ContractError, LoopwrightError, OutputError, SampleError
from loopwright.serving.graph.audit import audit
from loopwright.serving.manifest import INPUTS, MANIFEST_KEY, Manifest, Signal
from loopwright.serving.operating import Operate
from loopwright.serving.preview.differences import Differences
from loopwright.serving.ranges import numbers, switched

LONGEST_STEP_S = 1.0  # a fork waits no longer for a step
_locks: WeakSet[Lock] = WeakSet()  # of all controllers of this process
_held: list[Lock] = []  # by the thread that forks
_forking = Lock()


def step_lock() -> Lock:
    """A lock that is free in every child of this process, whoever holds it at the fork."""
    lock = Lock()
    _locks.add(lock)
    return lock


def _before() -> None:
    _forking.acquire()
    _held.extend(lock for lock in list(_locks) if lock.acquire(timeout=LONGEST_STEP_S))


def _in_parent() -> None:
    while _held:
        _held.pop().release()
    _forking.release()


def _in_child() -> None:
    _held.clear()
    for lock in (*_locks, _forking):
        if lock.locked():  # by this thread, or by one whose step took too long and that the child has not
            lock.release()


if hasattr(os, "register_at_fork"):  # where processes fork
    os.register_at_fork(before=_before, after_in_parent=_in_parent, after_in_child=_in_child)


# ------------------------------------------------------------------------------------------------------ the controller
Array: TypeAlias = NDArray[np.float64]
_LINE = 8  # float64 in a cache line: each vector starts on one, so that no result depends on its neighbours


class Step(NamedTuple):
    """One step's result: MV in engineering units, the state for the next step, and the info vector."""

    mv: Array  # shape: (n_mv,)
    state: Array  # shape: (n_state,)
    info: Array  # shape: (n_info,)


class Controller:
    """A control law in one file: ``(sp, pv, dv, mv_applied, state) -> (mv, state_next, info)``.

    Parameters
    ----------
    path
        The .onnx file that the pipeline exported.
    sha256
        The file's own SHA-256, if the host wants this very file and no other. The digest inside
        the file finds damage and careless edits; only a pinned digest finds a forged file.

    Raises
    ------
    ArtifactError
        The file is corrupt, truncated, foreign or changed, holds what a controller may not
        (see ``loopwright.serving.graph.audit``), or its manifest and its graph disagree.

    Notes
    -----
    A step holds a lock, because its buffers are bound to the session once and used by every step. A fork of the process
    waits for a step that is under way, so that the child finds buffers, session and lock as between two steps.
    """

    def __init__(self, path: str | PathLike[str], sha256: str | None = None) -> None:
        self.path = Path(path)
        try:
            data = read_controller(self.path, sha256)
            self.summary = audit(data)
            self.manifest = _manifest(self.summary.metadata)
            self._session = session_of(data)
            _agree(self.manifest, self._session)
        except ArtifactError as error:
            raise ArtifactError(f"{self.path}: {error}") from error.__cause__
        self.size_bytes = len(data)
        self.sha256 = file_digest(data)
        self.law_sha256 = law_digest(data, self.summary.metadata[MANIFEST_KEY])
        self._lock = step_lock()
        self._bind()

    def cold_state(self) -> Array:
        """State of zeros, shape (n_state,): no past. Also right after any gap."""
        return np.zeros(self.manifest.n_state)

    def step(
        self,
        *,
        sp: ArrayLike,
        pv: ArrayLike,
        mv_applied: ArrayLike,
        state: ArrayLike,
        dv: ArrayLike | None = None,
        operate: ArrayLike | None = None,
        fresh: ArrayLike | None = None,
        ahead: ArrayLike | None = None,
    ) -> Step:
        """One step of the law, in engineering units.

        Parameters
        ----------
        sp, pv, dv
            Set points (n_sp,), process variables (n_pv,), measured disturbances (n_dv,). A number
            stands for a vector of one. An input that the law does not use is ignored.
        mv_applied
            The MV that the plant really received over the last period, shape (n_mv,).
        state
            ``state`` of the last step, or ``cold_state()``; shape (n_state,).
        operate
            What operators have changed, shape (n_operate,), as the manifest's ``operate`` lists it; None: its defaults.
        fresh
            1 for each process variable whose reading is new and good, 0 for one that is neither, shape (n_pv,); None:
            all are. The number in ``pv`` must be finite all the same. It is not used, but for a first step without a
            past, which has nothing else to begin from: give the last good one.
        ahead
            By how much set points and measured disturbances will differ from ``sp`` and ``dv`` at the samples to come,
            shape (N n,), as the manifest's ``ahead`` lists them; None: they stay. See ``loopwright.serving.preview``.

        Raises
        ------
        ContractError
            An input has the wrong shape or type, or is missing; an entry of ``operate`` is outside its engineered
            range, ``fresh`` is neither 0 nor 1, ``ahead`` leaves a signal's range; the law does not read one of these
            three that is given.
        SampleError
            An input is not finite: no MV is computed from it.
        OutputError
            The law's output is not finite, lies outside the MV's range, or is further from ``mv_applied`` than the
            MV moves in a period (``max_move``).
        """
        given = (sp, pv, dv, mv_applied, state, *self._operated(operate, fresh), self._known(ahead, sp, dv))
        with self._lock:
            for place, name, buffer, shape in self._inputs:
                value = given[place]
                if type(value) is np.ndarray and value.dtype is _FLOAT64 and value.shape == shape:
                    buffer[...] = value
                else:
                    buffer[...] = self._vector(name, value, shape[0])
            # A sum of finite numbers may overflow; then the exact check clears the sample.
            fed = self._in.tolist()
            if not isfinite(sum(fed)):
                self._check_finite()
            try:
                self._session.run_with_iobinding(self._binding)
            except Exception as error:
                raise OutputError(f"the law cannot be computed: {_first_line(error)}") from error
            out = self._out.copy()
        n_mv, a, b, c, d = self._cuts
        values = out.tolist()
        for value, (low, high, allowed) in zip(values, self._ranges, strict=False):
            if not low <= value <= high or (allowed is not None and value not in allowed):
                self._refuse(values)
        if not isfinite(sum(values)):
            self._refuse(values)
        for i, at, signal in self._limited:
            if not signal.moves(fed[at], values[i]):
                self._refuse_move(signal, fed[at], values[i])
        return Step(out[:n_mv], out[a:b], out[c:d])

    @property
    def places(self) -> dict[str, slice]:
        """The numbers of each input, and of ``mv``, ``state_next`` and ``info``, in the rows of ``compute``."""
        n_mv, a, b, c, d = self._cuts
        starts = {
            name: ((part.ctypes.data - self._in.ctypes.data) // 8, len(part)) for _, name, part, _ in self._inputs
        }
        inputs = {name: slice(at, at + n) for name, (at, n) in starts.items()}
        return {**inputs, "mv": slice(0, n_mv), "state_next": slice(a, b), "info": slice(c, d)}

    def compute(self, given: Array) -> Array:
        """The graph's outputs (n, n_out) of rows (n, n_in), one after the other, with none of the checks of ``step``.

        Rows lie as ``places`` says. A row that is not finite, or that cannot be computed, gives nan.
        """
        taken = np.full((len(given), len(self._out)), np.nan)
        fit = np.all(np.isfinite(given), axis=1)
        with self._lock:
            run, binding, buffer, result = self._session.run_with_iobinding, self._binding, self._in, self._out
            for k in np.flatnonzero(fit).tolist():
                buffer[:] = given[k]
                with suppress(Exception):
                    run(binding)
                    taken[k] = result
        return taken

    @property
    def width(self) -> int:
        """Numbers of a row that ``compute`` takes."""
        return len(self._in)

    @property
    def width_out(self) -> int:
        """Numbers of a row that ``compute`` gives."""
        return len(self._out)

    def warm(self) -> None:
        """Two discarded steps on the last inputs: just before a deadline they bring code and weights into the caches.

        The state is explicit, so a discarded step changes nothing. The second one costs a tenth of
        the first and takes another tenth off the real one.
        """
        last: dict[str, Any] = dict.fromkeys(INPUTS)
        last |= {name: buffer.copy() for _, name, buffer, _ in self._inputs}
        try:
            self.step(**last)
            self.step(**last)
        except LoopwrightError:
            self._reset()

    # ------------------------------------------------------------------ buffers
    def _bind(self) -> None:
        """One buffer for all inputs and one for all outputs, bound to the session for good."""
        m = self.manifest
        sizes = m.sizes()
        self._in, parts = _vectors([sizes[name] for name in m.inputs])
        self._inputs = [(INPUTS.index(n), n, part, part.shape) for n, part in zip(m.inputs, parts, strict=True)]
        self._out, outs = _vectors([len(m.mv), m.n_state, len(m.info)])
        starts = [(p.ctypes.data - self._out.ctypes.data) // 8 for p in outs]
        self._cuts = (len(m.mv), starts[1], starts[1] + m.n_state, starts[2], starts[2] + len(m.info))
        self._operate = Operate(m.operate) if "operate" in m.inputs else None
        self._reads_fresh = "fresh" in m.inputs
        self._all_fresh = np.ones(len(m.pv))
        self._ahead = Differences(m.ahead) if m.ahead is not None and "ahead" in m.inputs else None
        self._ranges = [(s.low, s.high, s.values) for s in m.mv]
        begins = next(
            ((part.ctypes.data - self._in.ctypes.data) // 8 for _, n, part, _ in self._inputs if n == "mv_applied"), 0
        )
        # Each MV whose moves are limited: its place, that of its applied value among the inputs, and its signal.
        self._limited = [(i, begins + i, s) for i, s in enumerate(m.mv) if s.most < inf]
        self._binding = self._session.io_binding()
        for _, name, part, shape in self._inputs:
            self._binding.bind_input(name, "cpu", 0, np.float64, shape, part.ctypes.data)
        for name, part in zip(("mv", "state_next", "info"), outs, strict=True):
            if part.size:
                self._binding.bind_output(name, "cpu", 0, np.float64, part.shape, part.ctypes.data)
        self._reset()

    def _operated(self, operate: ArrayLike | None, fresh: ArrayLike | None) -> tuple[Any, Any]:
        """``operate`` and ``fresh``, checked; their defaults where there are none."""
        if self._operate is None:
            self._require_none("operate", operate)
        else:
            operate = self._operate.default if operate is None else self._operate.checked(operate)
        if not self._reads_fresh:
            self._require_none("fresh", fresh)
            return operate, None
        if fresh is None:
            return operate, self._all_fresh
        known = self._vector("fresh", switched(fresh), len(self.manifest.pv))
        if not ((known == 0) | (known == 1)).all():
            raise ContractError(f"fresh is {known.tolist()}; each is 1 for a new and good reading, or 0")
        return operate, known

    def _known(self, ahead: ArrayLike | None, sp: ArrayLike, dv: ArrayLike | None) -> Any:
        """``ahead``, checked; zeros where there is none."""
        if self._ahead is None:
            self._require_none("ahead", ahead)
            return None
        if ahead is None:
            return self._ahead.none
        m = self.manifest
        present = [self._vector("sp", sp, len(m.sp)), *([self._vector("dv", dv, len(m.dv))] if m.dv else [])]
        return self._ahead.checked(ahead, np.concatenate(present))

    def _require_none(self, name: str, given: object) -> None:
        if given is not None:
            m = self.manifest
            raise ContractError(f"the law {m.law!r} does not read {name}; its inputs are {', '.join(m.inputs)}")

    def _reset(self) -> None:
        """Inputs that any law can be warmed with: the middle of each range, no past."""
        with self._lock:
            for _, name, buffer, _ in self._inputs:
                buffer[...] = self.manifest.usual(name)

    # ------------------------------------------------------------------ refusals
    def _vector(self, name: str, value: object, length: int) -> Array:
        """``value`` as float64 of shape (length,); ContractError says what is allowed."""
        if value is None:
            raise ContractError(f"{name} is missing; the law {self.manifest.law!r} needs {self._allowed(name)}")
        try:
            array = numbers(value)
        except TypeError as error:
            raise ContractError(f"{name} {error}; it needs numbers: {self._allowed(name)}") from error
        if array.ndim == 0 and length == 1:
            array = array.reshape(1)
        if array.shape != (length,):
            raise ContractError(f"{name} has the shape {array.shape}; it needs {self._allowed(name)}")
        return array.astype(np.float64)

    def _allowed(self, name: str) -> str:
        if name == "state":
            return f"shape ({self.manifest.n_state},), from the last step or cold_state()"
        signals = self.manifest.signals("pv" if name == "fresh" else name)
        return f"shape ({len(signals)},): {', '.join(f'{s.name} [{s.unit}]' for s in signals)}"

    def _check_finite(self) -> None:
        for _, name, buffer, _ in self._inputs:
            for i, value in enumerate(buffer.tolist()):
                if not isfinite(value):
                    signals = self.manifest.signals(name)
                    label = f"{signals[i].name} [{signals[i].unit}]" if signals else f"entry {i}"
                    raise SampleError(f"{name}: {label} is {value}; no MV is computed from a value that is not finite")

    def _refuse(self, values: list[float]) -> None:
        """Raise OutputError for the first output that is wrong; silent if only their sum overflowed."""
        n_mv, a, b, c, d = self._cuts
        for label, part in (("mv", values[:n_mv]), ("state_next", values[a:b]), ("info", values[c:d])):
            for i, value in enumerate(part):
                if not isfinite(value):
                    raise OutputError(f"the law gave {label}[{i}] = {value}, which is not finite")
        for signal, value in zip(self.manifest.mv, values[:n_mv], strict=True):
            if not signal.low <= value <= signal.high:
                raise OutputError(
                    f"the law gave {signal.name} = {value} {signal.unit}, "
                    f"outside its range [{signal.low:g}, {signal.high:g}] {signal.unit}"
                )
            if signal.values is not None and value not in signal.values:
                raise OutputError(f"the law gave {signal.name} = {value}; it may be one of {list(signal.values)}")

    @staticmethod
    def _refuse_move(signal: Signal, applied: float, value: float) -> NoReturn:
        raise OutputError(
            f"the law gave {signal.name} = {value} {signal.unit} after {applied} {signal.unit}; it may move by at most "
            f"{signal.max_move:g} {signal.unit} a period"
        )


_FLOAT64 = np.dtype(np.float64)


def _vectors(lengths: list[int]) -> tuple[Array, list[Array]]:
    """One zeroed buffer and its parts, each starting on a cache line."""
    lines = [-(-n // _LINE) for n in lengths]
    raw = np.zeros((sum(lines) + 1) * _LINE)
    first = (-raw.ctypes.data // 8) % _LINE
    whole = raw[first : first + sum(lines) * _LINE]
    starts = np.cumsum([0, *lines]) * _LINE
    return whole, [whole[s : s + n] for s, n in zip(starts, lengths, strict=False)]


def _manifest(metadata: dict[str, str]) -> Manifest:
    if MANIFEST_KEY not in metadata or DIGEST_KEY not in metadata:
        raise ArtifactError(f"the file has no {MANIFEST_KEY}: it is an ONNX model, but no Loopwright controller")
    strange = sorted(set(metadata) - {MANIFEST_KEY, DIGEST_KEY})
    if strange:  # onnxruntime takes settings from some entries
        raise ArtifactError(f"the file has the metadata entry {strange[0]!r}, which no controller has")
    return Manifest.from_json(metadata[MANIFEST_KEY])


def session_of(data: bytes) -> Any:
    """An onnxruntime session for one small graph in a control loop: one thread that never spins."""
    import onnxruntime as ort  # here, so that `import serving` costs nothing

    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_ALL
    options.enable_mem_reuse = False  # 8 % faster on small graphs; the bits are the same
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    # The bytes were read as ONNX; onnxruntime would guess its own format from bytes 4 to 8.
    options.add_session_config_entry("session.load_model_format", "ONNX")
    options.log_severity_level = 4  # what goes wrong is raised, not logged
    try:
        return ort.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's exceptions have no public base
        raise ArtifactError(f"onnxruntime does not load the graph: {_first_line(error)}") from error


def runtime_version() -> str:
    """The release of onnxruntime that computes the steps."""
    import onnxruntime as ort

    return str(ort.__version__)


def _agree(manifest: Manifest, session: Any) -> None:
    """ArtifactError unless the graph has exactly the inputs and outputs that the manifest tells."""
    sizes = manifest.sizes()
    wanted_in = {name: sizes[name] for name in manifest.inputs}
    outputs = {"mv": len(manifest.mv), "state_next": manifest.n_state, "info": len(manifest.info)}
    wanted_out = {name: n for name, n in outputs.items() if n}
    for kind, wanted, nodes in (
        ("inputs", wanted_in, session.get_inputs()),
        ("outputs", wanted_out, session.get_outputs()),
    ):
        found = {node.name: f"{node.type}{node.shape}" for node in nodes}
        expected = {name: f"tensor(double){[n]}" for name, n in wanted.items()}
        if found != expected:
            raise ArtifactError(f"the graph's {kind} are {found}, but its manifest says {expected}")


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
