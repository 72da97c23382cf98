"""Calls of the system and of the OpenCL driver that can be counted and made to fail, one of them at a time.

The calls are those of Python: what pycolmap's C++ code or the driver itself asks of the system is not seen.
"""

import errno
import fcntl
import io
import json
import os
import re
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pyopencl as cl
import pytest

from clsplat.buffers import Buffers
from clsplat.device import Device
from clsplat.programs import kernel_folder

RANDOM = (
    (re.compile(r"\.(.*)\.[0-9a-f]{16}\.part"), r"\1.part"),
    (re.compile(r"(tmp|clsplat_triangulate_|clsplat_sfm_)[a-z0-9_]{8}"), r"\1"),
    (re.compile(r"events\.out\.tfevents\..*"), "events"),
)
"""Parts of names of files that differ from run to run, and what stands for them."""


class Point(NamedTuple):
    """One call of a run: its kind, the file or kernel it is about, and how many of the same came before it."""

    kind: str
    about: str
    index: int


class Fault(NamedTuple):
    """The error that a call ends with. A lasting one fails all later calls of the `family` too."""

    error: Callable[[str], Exception]
    family: tuple[str, ...] = ()


def system(number: int) -> Callable[[str], OSError]:
    """The system's error of a number, about a file; an open file has no name."""
    return lambda path: OSError(number, os.strerror(number), *[path] * bool(path))


def driver(kind: type[Exception], routine: str, code: int) -> Callable[[str], Exception]:
    """An error as pyopencl makes it of a driver's status."""
    return lambda _: kind(cl._cl._ErrorRecord(routine, code, ""))


TRANSFERS = ("launch", "upload", "download", "wait", "copy", "allocate")
"""Kinds of calls that all fail once a device is lost."""

_STATUS = cl.status_code
FAULTS: dict[str, dict[str, Fault]] = {
    "open": {"EACCES": Fault(system(errno.EACCES)), "EMFILE": Fault(system(errno.EMFILE))},
    "read": {"EIO": Fault(system(errno.EIO))},
    "write": {"ENOSPC": Fault(system(errno.ENOSPC), ("write",)), "EIO": Fault(system(errno.EIO))},
    "fsync": {"EIO": Fault(system(errno.EIO))},
    "replace": {"EACCES": Fault(system(errno.EACCES))},
    "mkdir": {"ENOSPC": Fault(system(errno.ENOSPC))},
    "unlink": {"EACCES": Fault(system(errno.EACCES)), "EIO": Fault(system(errno.EIO))},
    "rmdir": {"EIO": Fault(system(errno.EIO))},
    "list": {"EIO": Fault(system(errno.EIO))},
    "lock": {"ENOLCK": Fault(system(errno.ENOLCK))},
    "context": {"resources": Fault(driver(cl.RuntimeError, "clCreateContext", _STATUS.OUT_OF_HOST_MEMORY))},
    "queue": {"resources": Fault(driver(cl.RuntimeError, "clCreateCommandQueue", _STATUS.OUT_OF_RESOURCES))},
    "build": {"resources": Fault(driver(cl.RuntimeError, "clBuildProgram", _STATUS.BUILD_PROGRAM_FAILURE))},
    "allocate": {
        "memory": Fault(driver(cl.MemoryError, "clCreateBuffer", _STATUS.MEM_OBJECT_ALLOCATION_FAILURE)),
        "resources": Fault(driver(cl.RuntimeError, "clCreateBuffer", _STATUS.OUT_OF_RESOURCES)),
    },
    "upload": {
        "lost": Fault(driver(cl.LogicError, "clEnqueueWriteBuffer", _STATUS.INVALID_COMMAND_QUEUE), TRANSFERS)
    },
    "download": {
        "resources": Fault(driver(cl.RuntimeError, "clEnqueueReadBuffer", _STATUS.OUT_OF_RESOURCES), TRANSFERS)
    },
    "wait": {
        "status": Fault(
            driver(cl.RuntimeError, "clWaitForEvents", _STATUS.EXEC_STATUS_ERROR_FOR_EVENTS_IN_WAIT_LIST), TRANSFERS
        )
    },
    "copy": {"resources": Fault(driver(cl.RuntimeError, "clEnqueueCopyBuffer", _STATUS.OUT_OF_RESOURCES))},
    "launch": {"resources": Fault(driver(cl.RuntimeError, "clEnqueueNDRangeKernel", _STATUS.OUT_OF_RESOURCES))},
}
"""Errors of each kind of call, by name."""


class Calls:
    """The calls of a run, of which one may fail.

    Parameters
    ----------
    point : Point, optional
        The call that fails; default: none does.
    fault : Fault, optional
        How it fails.

    Attributes
    ----------
    points : list of Point
        The calls so far. Threads may swap their order; each point is the same call in every run.
    failed : bool
        Whether the call was reached.
    """

    def __init__(self, point: Point | None = None, fault: Fault | None = None):
        self.points: list[Point] = []
        self.failed = False
        self.point, self.fault = point, fault
        self._counts: Counter[tuple[str, str]] = Counter()
        self._lock = threading.Lock()

    def error(self, kind: str, about: str, path: str = "") -> Exception | None:
        """Count a call; return the error that it ends with, if it fails."""
        with self._lock:
            for pattern, name in RANDOM:
                about = pattern.sub(name, about)
            point = Point(kind, about, self._counts[kind, about])
            self._counts[kind, about] += 1
            self.points.append(point)
            fails = point == self.point or (self.failed and self.fault is not None and kind in self.fault.family)
            self.failed |= fails
            return self.fault.error(path) if fails and self.fault else None

    def check(self, kind: str, about: str, path: str = "") -> None:
        """Count a call, and raise the error that it ends with, if it fails."""
        if error := self.error(kind, about, path):
            raise error


class File(io.FileIO):
    """A file whose reads and writes are counted. A write that fails has written the first half."""

    def __init__(self, path: Any, mode: str, calls: Calls, name: str, **others: Any):
        super().__init__(path, mode, **others)
        self._calls, self._name = calls, name

    def write(self, data: Any) -> int:
        if error := self._calls.error("write", self._name):
            super().write(memoryview(data).cast("B")[: len(data) // 2])
            raise error
        return super().write(data)

    def readinto(self, buffer: Any) -> int:
        self._calls.check("read", self._name)
        return super().readinto(buffer)

    def readall(self) -> bytes:
        self._calls.check("read", self._name)
        return super().readall()


@contextmanager
def watched(root: Path, calls: Calls, replaced: Callable[[Path], None] = lambda path: None) -> Iterator[None]:
    """Count the calls of the block.

    Parameters
    ----------
    root : Path
        Files in this folder, and the sources of the kernels, count.
    calls : Calls
    replaced : callable
        Called with each file that `os.replace` has put in its place.
    """
    with pytest.MonkeyPatch.context() as patch:
        _watch_files(patch, root, calls, replaced)
        _watch_device(patch, calls)
        yield


def _watch_files(patch: pytest.MonkeyPatch, root: Path, calls: Calls, replaced: Callable[[Path], None]) -> None:
    opened: dict[int, str] = {}  # names of the folders and files that os.open opened

    def named(path: Any) -> str | None:
        if isinstance(path, int):
            return None
        path = Path(os.path.abspath(os.fsdecode(path)))
        for folder in (root, kernel_folder()):
            if path.is_relative_to(folder):
                return str(path.relative_to(folder))
        return None

    def counted(kind: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(path: Any, *arguments: Any, **named_arguments: Any) -> Any:
            name = opened.get(path) if isinstance(path, int) else named(path)
            if name is not None:
                calls.check(kind, name, "" if isinstance(path, int) else os.fspath(path))
            return function(path, *arguments, **named_arguments)

        return call

    plain = io.open

    def open_(
        path: Any,
        mode: str = "r",
        buffering: int = -1,
        encoding: Any = None,
        errors: Any = None,
        newline: Any = None,
        closefd: bool = True,
        opener: Any = None,
    ) -> Any:
        name = named(path)
        if name is None:
            return plain(path, mode, buffering, encoding, errors, newline, closefd, opener)
        calls.check("open", name, os.fspath(path))
        raw = File(path, mode.replace("b", "").replace("t", ""), calls, name, opener=opener)
        opened[raw.fileno()] = name
        if buffering == 0:
            return raw
        kind = io.BufferedRandom if "+" in mode else io.BufferedReader if "r" in mode else io.BufferedWriter
        file = kind(raw)
        return file if "b" in mode else io.TextIOWrapper(file, encoding, errors, newline)

    open_file, replace, lock = os.open, os.replace, fcntl.flock

    def open_number(path: Any, *arguments: Any, **others: Any) -> int:
        name = None if others.get("dir_fd") is not None else named(path)
        if name is not None:
            calls.check("open", name, os.fspath(path))
        number = open_file(path, *arguments, **others)
        opened[number] = name or "."
        return number

    def sync_(file: Any) -> None:  # the disk itself is not waited for
        calls.check("fsync", opened.get(file, "file"))

    def replace_(source: Any, target: Any) -> None:
        name = named(target)
        if name is not None:
            calls.check("replace", name, os.fspath(target))
        replace(source, target)
        if name is not None:
            replaced(Path(target))

    def lock_(file: Any, operation: int) -> None:
        if operation != fcntl.LOCK_UN:
            calls.check("lock", "lock")
        lock(file, operation)

    patch.setattr("builtins.open", open_)
    patch.setattr(io, "open", open_)
    patch.setattr(os, "open", open_number)
    patch.setattr(os, "fsync", sync_)
    patch.setattr(os, "replace", replace_)
    patch.setattr(fcntl, "flock", lock_)
    for name, kind in (("mkdir", "mkdir"), ("unlink", "unlink"), ("remove", "unlink"), ("rmdir", "rmdir")):
        patch.setattr(os, name, counted(kind, getattr(os, name)))
    patch.setattr(os, "listdir", counted("list", os.listdir))


class Pool:
    """A memory pool of pyopencl whose allocations are counted."""

    def __init__(self, pool: Any, calls: Calls):
        self._pool, self._calls = pool, calls

    def allocate(self, size: int) -> Any:
        """Allocate a block."""
        self._calls.check("allocate", "buffer")
        return self._pool.allocate(size)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._pool, name)


def _watch_device(patch: pytest.MonkeyPatch, calls: Calls) -> None:
    allocate, launch, program, copy = Buffers.allocate, Device.launch, Device.program, cl.enqueue_copy
    wait = cl.Event.wait

    def allocate_(self: Buffers, *arguments: Any) -> Any:
        pool, self.pool = self.pool, Pool(self.pool, calls)
        try:
            return allocate(self, *arguments)
        finally:
            self.pool = pool

    def launch_(self: Device, stage: str, kernel: str, *arguments: Any, **named: Any) -> None:
        calls.check("launch", kernel)
        launch(self, stage, kernel, *arguments, **named)

    def program_(self: Device, stage: str, defines: Any) -> Any:
        calls.check("build", stage)
        return program(self, stage, defines)

    def copy_(queue: Any, target: Any, source: Any, **named: Any) -> Any:
        kinds = {(True, False): "download", (False, True): "upload"}
        calls.check(kinds.get((hasattr(target, "shape"), hasattr(source, "shape")), "copy"), "buffer")
        return copy(queue, target, source, **named)

    def wait_(self: cl.Event) -> None:
        calls.check("wait", "event")
        wait(self)

    def counted(kind: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            calls.check(kind, "device")
            return function(*arguments, **named)

        return call

    patch.setattr(Buffers, "allocate", allocate_)
    patch.setattr(Device, "launch", launch_)
    patch.setattr(Device, "program", program_)
    patch.setattr(cl, "enqueue_copy", copy_)
    patch.setattr(cl.Event, "wait", wait_)
    named = vars(cl) | {"Context": counted("context", cl.Context), "CommandQueue": counted("queue", cl.CommandQueue)}
    patch.setattr(
        "clsplat.device.cl", SimpleNamespace(**named)
    )  # pyopencl itself asks for instances of these classes


def is_json(line: str) -> bool:
    """Whether a line of a log is whole."""
    try:
        return isinstance(json.loads(line), dict)
    except ValueError:
        return False
