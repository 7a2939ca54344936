"""``python -m pipeline.engine.warm COMMAND...``: run a command whose stages need not import their libraries.

torch, casadi, pandas and the like take a stage longer to import than most take to work. This
process imports them once, runs the command (``dvc repro``), and forks for every stage that
``pipeline.engine.start`` asks for. Of the pipeline itself it imports nothing, so that a stage runs the
sources as they are when it starts. It lives as long as the command. Without it, and where it dies,
stages start by themselves: slower, with the same results.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import selectors
import signal
import socket
import subprocess
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pipeline.engine.lifeline import end_with_parent
from pipeline.engine.start import VARIABLE, run_here, served

# What stages import for long; one that is missing or broken here costs time alone.
LIBRARIES = (
    *("numpy", "scipy.linalg", "scipy.optimize", "scipy.signal", "scipy.sparse.linalg", "pandas", "pyarrow.parquet"),
    *("yaml", "joblib", "cloudpickle", "threadpoolctl", "rich.progress", "casadi", "jinja2", "matplotlib.figure"),
    *("torch", "torch._dynamo", "torch.export._trace", "torch.onnx._internal.exporter._compat", "sklearn.linear_model"),
    *("onnx", "onnx_ir", "onnxruntime", "onnxscript.optimizer", "onnxscript.function_libs.torch_lib.ops"),
)
POLL_S = 0.5
STOPPED = 130  # exit status of a stage that was ended with the whole run, as a shell counts Ctrl-C


def main(argv: Sequence[str]) -> int:
    """Run the command; its exit status."""
    command = list(argv)
    if not command:
        print(
            "usage: python -m pipeline.engine.warm COMMAND..., such as: python -m pipeline.engine.warm dvc repro",
            file=sys.stderr,
        )
        return 2
    if sys.platform != "linux":  # elsewhere the system's own libraries do not survive a fork
        return _cold(command)
    with TemporaryDirectory(prefix="loopwright-") as folder, socket.socket(socket.AF_UNIX) as door:
        address = str(Path(folder) / "stages")
        try:
            door.bind(address)
        except OSError:  # a path that is too long for a socket
            return _cold(command)
        door.listen()
        return _Server(door, command, address).run()


def _cold(command: list[str]) -> int:
    """Exit status of the command, whose stages start by themselves; SIGTERM is passed on."""
    with subprocess.Popen(command) as process:
        signal.signal(signal.SIGTERM, lambda *_: process.terminate())
        code = process.wait()
    return 128 - code if code < 0 else code


class _Server:
    """The command and the stages that run for it."""

    def __init__(self, door: socket.socket, command: list[str], address: str) -> None:
        self.door, self.stages = door, dict[int, socket.socket]()
        self.waiting = selectors.DefaultSelector()
        self.waiting.register(door, selectors.EVENT_READ)
        # An ended process wakes the loop. Ctrl-C is for the command, which is asked by the terminal itself; stages
        # ignore it where this process was started so: then who started it ends them all, by SIGTERM.
        self.wake, self.wakened = socket.socketpair()
        self.wakened.setblocking(False)
        self.waiting.register(self.wake, selectors.EVENT_READ)
        signal.set_wakeup_fd(self.wakened.fileno(), warn_on_full_buffer=False)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        self.deaf = signal.getsignal(signal.SIGINT) == signal.SIG_IGN
        if not self.deaf:
            signal.signal(signal.SIGINT, lambda *_: None)
        environment = {**os.environ, VARIABLE: json.dumps([address, *served()])}
        own = os.getpid()
        self.command = subprocess.Popen(command, env=environment, preexec_fn=lambda: end_with_parent(own))
        self.stopped = False
        signal.signal(signal.SIGTERM, lambda *_: self._stop())

    def run(self) -> int:
        """Serve until the command ends."""
        for name in LIBRARIES:  # while the command starts; stages that come meanwhile wait at the door
            if self.command.poll() is not None or self.stopped:
                break  # nothing is to be done
            with contextlib.suppress(Exception):
                importlib.import_module(name)
        try:
            while self.command.poll() is None:
                for key, _ in self.waiting.select(POLL_S):
                    if key.fileobj is self.wake:
                        self.wake.recv(4096)
                    elif key.fileobj is self.door:
                        self._begin()
                    else:
                        self._abandon(key.data)
                if self.stopped:
                    self._end_stages()
                self._report()
        finally:
            self._end_stages()
        code = self.command.returncode
        return 128 - code if code < 0 else code  # of a command that a signal ended, as a shell counts

    def _stop(self) -> None:
        """Tell the command, which from now on says nothing of the stages that end, and refuse further ones."""
        self.stopped = True
        self.command.terminate()

    def _end_stages(self) -> None:
        for pid in self.stages:
            os.kill(pid, signal.SIGTERM)

    def _begin(self) -> None:
        """Fork for the stage that asks at the door."""
        line, _ = self.door.accept()
        line.settimeout(10)  # who asks has its whole request ready
        try:
            _, files, _, _ = socket.recv_fds(line, 1, 3)
            with line.makefile() as reader:
                request = json.loads(reader.readline())
        except (OSError, ValueError):
            line.close()
            return
        if self.stopped:
            for file in files:
                os.close(file)
            _answer(line, STOPPED)
            return
        sys.stdout.flush()
        sys.stderr.flush()
        own, pid = os.getpid(), os.fork()
        if not pid:
            end_with_parent(own)
            self._become(request, files)
        for file in files:
            os.close(file)
        self.stages[pid] = line
        self.waiting.register(line, selectors.EVENT_READ, pid)

    def _become(self, request: dict[str, Any], files: list[int]) -> None:
        """Run the stage in the fork, in place of the process that asked. It does not return."""
        code = 1
        try:
            signal.set_wakeup_fd(-1)
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            signal.signal(signal.SIGINT, signal.SIG_IGN if self.deaf else signal.default_int_handler)
            self.waiting.close()
            for own in (self.door, self.wake, self.wakened, *self.stages.values()):
                own.close()
            for target, file in enumerate(files):
                os.dup2(file, target)
                os.close(file)
            os.environ.clear()
            os.environ.update(request["environment"])
            run_here(request["arguments"])
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
            if isinstance(end.code, str):
                print(end.code, file=sys.stderr)
        except KeyboardInterrupt:
            code = STOPPED
        except BaseException:
            traceback.print_exc()
        finally:
            with contextlib.suppress(OSError, ValueError):
                sys.stdout.flush()
                sys.stderr.flush()
            os._exit(code)

    def _abandon(self, pid: int) -> None:
        """Nobody waits for this stage any more."""
        self.waiting.unregister(self.stages[pid])
        os.kill(pid, signal.SIGTERM)

    def _report(self) -> None:
        """Tell those who wait for stages that have ended."""
        for pid, line in list(self.stages.items()):
            ended, status = os.waitpid(pid, os.WNOHANG)
            if not ended:
                continue
            with contextlib.suppress(KeyError):
                self.waiting.unregister(line)
            _answer(line, STOPPED if self.stopped and status else os.waitstatus_to_exitcode(status))
            del self.stages[pid]


def _answer(line: socket.socket, code: int) -> None:
    """Tell who waits for a stage how it ended."""
    with contextlib.suppress(OSError):
        line.sendall(f"{code}\n".encode())
    line.close()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
