"""Faults below Python: a command runs again and again, and each time a call of a C library that it uses fails.

``make faults-below``, which sets the path of the test modules. Each run is a process of its own, forked from this
one, with the library of faults_below.c. The report, below.jsonl, has a line for each point; the program goes on after
the last one if it is started again. Where PoCL or LLVM ends the process, no sentence is expected: as after a kill,
files must be whole, and the same command again must leave the same bits. Linux only.
"""

import atexit
import ctypes
import json
import os
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from math import inf
from pathlib import Path
from typing import Any

import matplotlib.figure  # noqa: F401  (loaded once, before all forks)
import pytest
import tyro
from cli_runs import write_dataset
from failing_below import FAULTS, RANDOM, Point, environment, library
from fault_commands import PHOTOS, TRAIN
from lone_commands import digest, outside, status_of
from measure_faults import Command, Ended
from PIL import Image
from textured_corner import take_photos

import clsplat.dataset.sfm.reconstruction
import clsplat.training.loop  # noqa: F401  (loaded once)
from clsplat.commands.console import Out

IDLE, IDLE_SHARE = 40.0, 0.005
"""A run hangs if its processes get less than this share of a core for so long, s. Its time alone does not tell: on a
busy machine, a run of seconds takes minutes."""

PROCESSOR_SECONDS = 150.0
"""Processor time after which a run hangs too, s. Without a fault, all take less than twenty."""

DRIVER_ENDS = ("LLVM ERROR", "terminate called", "Final linking of kernel", "missing symbols in the kernel")
"""What LLVM, the library of C++ and PoCL print where they end the process by SIGABRT; COLMAP has one of its own."""

SHORT = (*TRAIN[:5], "6", "--checkpoint-every", "3", "--eval-every", "3", *TRAIN[10:12])
COMMANDS = {
    "train": SHORT,
    "train, cold cache": SHORT,
    "render, cold cache": ("render", "scene.ply", "data", "-o", "out", "--depth"),
    "eval": ("eval", "scene.ply", "data", "-o", "out"),
    "render": ("render", "scene.ply", "data", "-o", "out", "--depth"),
    "export": ("export", "scene.ply", "out/scene.sog"),
    "sfm": ("sfm", "photos", "-o", "out", "--camera-model", "SIMPLE_RADIAL"),
}
"""Commands by name. The cache of the driver has all kernels except where the name says that it is cold."""


class Below(Command):
    """A command of which calls of C libraries fail."""

    commands = COMMANDS
    faults: Any = FAULTS

    def __init__(self, name: str, root: Path):
        self._cold, self._scratch = "cold" in name, root.with_name("scratch")
        self._kernels: frozenset[tuple[str, str]] = frozenset()
        self.aborted = False  # by the driver, in the last run
        super().__init__(name, root)
        self._kernels = self._cache()
        self.points: Any = list(dict.fromkeys(self._recorded()))

    def group(self, point: Any) -> str:
        """The group of a call for `cases`: its kind, its process and what it is about."""
        return f"{point.process} {point.kind} {point.about}"

    def _recorded(self) -> Iterator[Point]:
        counts: Counter[tuple[str, ...]] = Counter()
        for line in (self._scratch / "log").read_text().splitlines():
            process, number, kind, about = line.split(" ", 3)
            for pattern, name in RANDOM:
                about = pattern.sub(name, about)
            yield Point(kind, about, counts[number, kind, about], process)
            counts[number, kind, about] += 1

    def _clear(self) -> None:
        super()._clear()
        shutil.rmtree(self._root / "cache", ignore_errors=True)
        if self._cold:
            (self._root / "cache").mkdir()
        else:
            shutil.copytree(self._root / "warm", self._root / "cache")

    def _run(self, calls: Any, more: Iterable[str] = (), fresh: bool = False) -> Ended:
        shutil.rmtree(self._scratch, ignore_errors=True)
        self._scratch.mkdir()
        variables = environment(self._root, self._scratch, calls.point, calls.fault)

        def work() -> int:
            os.environ.update(variables)
            ctypes.CDLL(None).below_start()
            with outside(self._root, inf) as stray, pytest.MonkeyPatch.context() as patch:
                if not calls.point:
                    patch.setattr(os, "replace", self._noting(os.replace))
                status = status_of([*self._arguments, *more])
            (self._scratch / "stray").write_text(json.dumps(stray))
            return status

        status, printed, left = apart(work, self._scratch / "printed")
        calls.failed = (self._scratch / "state").exists()
        stray = self._scratch / "stray"
        strays = json.loads(stray.read_text()) if stray.exists() else []
        versions = self._scratch / "versions"
        if versions.exists():
            self._versions.update((name, digest_) for name, digest_ in map(json.loads, versions.open()))
        return Ended(status, printed, strays + ["a process is left"] * left)

    def _wrong_end(self, ended: Ended, point: Any) -> list[str]:
        said = any(words in ended.printed for words in DRIVER_ENDS)
        self.aborted = ended.status == -signal.SIGABRT and said
        return [] if self.aborted else super()._wrong_end(ended, point)

    def _wrong_files(self, point: Any) -> list[str]:
        """As after a kill, a lock, a part or a temporary file may be left where the driver has ended the process."""
        found = super()._wrong_files(point)
        return [what for what in found if "left" not in what] if self.aborted else found

    def _noting(self, replace: Callable[[Any, Any], None]) -> Callable[[Any, Any], None]:
        def noting(source: Any, target: Any) -> None:
            replace(source, target)
            with (self._scratch / "versions").open("a") as file:
                file.writelines(json.dumps(version) + "\n" for version in self._versions_of(Path(target)))

        return noting

    def _cache(self) -> frozenset[tuple[str, str]]:
        """The driver's files, apart from temporary ones; programs contain temporary names."""
        files = [path for path in (self._root / "cache").rglob("*") if path.is_file()]
        return frozenset(
            (str(path), digest(path) if path.suffix == ".so" else str(path.stat().st_size))
            for path in files
            if "tempfile_" not in path.name
        )

    def _state(self) -> frozenset[tuple[str, str]]:
        return super()._state() | self._cache()

    def _done(self, whole: bool) -> bool:
        """A run that ended well may have left a file in the driver's cache that breaks the next one."""
        if whole and self._cache() != self._kernels:
            shutil.rmtree(self._out)
            if not self._trains:
                self._out.mkdir()
            return False
        return whole


def apart(work: Callable[[], int], printed: Path) -> tuple[int, str, bool]:
    """Do work in a fork of this process: its status (negative: the signal that ended it), what it printed, and
    whether a process that it has started is left."""
    process = os.fork()
    if process == 0:
        status = 1
        with suppress(BaseException):
            os.setsid()
            file = os.open(printed, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
            os.dup2(file, 1), os.dup2(file, 2)
            status = work()
            threading._shutdown()  # type: ignore[attr-defined]
            atexit._run_exitfuncs()
            sys.stdout.flush()
        ctypes.CDLL(None).exit(status)  # with the libraries' own clean-up
    found, since, used = 0, time.monotonic(), 0.0
    while found == 0:
        found, code = os.waitpid(process, os.WNOHANG)
        time.sleep(0.01)
        if time.monotonic() > since + IDLE:
            now = processor_time(process)
            if now - used < IDLE_SHARE * IDLE or now > PROCESSOR_SECONDS:
                with printed.open("a") as file:
                    file.write("Exception: hung")
                break
            since, used = time.monotonic(), now
    left = alive(process)
    with suppress(ProcessLookupError):
        os.killpg(process, signal.SIGKILL)
    if not found:
        _, code = os.waitpid(process, 0)
    return os.waitstatus_to_exitcode(code), printed.read_text(errors="replace"), left


def processor_time(group: int) -> float:
    """Processor time of the processes in a group, and of those that they have waited for, s."""
    ticks = 0
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            fields = path.read_text().rpartition(")")[2].split()
            ticks += sum(map(int, fields[11:15])) if int(fields[2]) == group else 0
    return ticks / os.sysconf("SC_CLK_TCK")


def alive(group: int) -> bool:
    """Whether processes of a group are left ten seconds after the one that started them."""
    for _ in range(1000):
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return False
        time.sleep(0.01)
    return True


def prepared(root: Path) -> Path:
    """Write photos, a dataset, a scene that is trained on it, and a cache with all kernels to a folder."""
    (root / "tmp").mkdir(parents=True)
    (root / "photos").mkdir()
    for k, photo in enumerate(take_photos(0)):
        Image.fromarray(photo).reduce(2).save(root / "photos" / f"photo {k}.png")

    def work() -> int:
        os.environ["POCL_CACHE_DIR"] = str(root / "warm")
        (root / "warm").mkdir()
        write_dataset(root / "data", PHOTOS)
        with outside(root, inf):
            return sum(
                status_of([*arguments])
                for arguments in (
                    (*SHORT[:3], "first", *SHORT[4:]),
                    ("export", "first", "scene.ply"),
                    ("eval", "scene.ply", "data", "-o", "evaluated"),
                    ("render", "scene.ply", "data", "-o", "rendered", "--depth"),
                )
            )

    status, printed, _ = apart(work, root / "printed")
    assert status == 0, printed
    for name in ("first", "evaluated", "rendered"):
        shutil.rmtree(root / name)
    return root


def measure(out: Out, commands: tuple[str, ...] = tuple(COMMANDS), per_group: int = 3) -> None:
    """Fail calls of C libraries in the commands, at most so many of each kind, file and process."""
    out.mkdir(parents=True, exist_ok=True)
    built = library(out)
    if built is None:
        sys.exit("faults below Python are measured on Linux, with the compiler cc: skipped")
    if str(built.resolve()) not in os.environ.get("LD_PRELOAD", ""):
        os.environ["LD_PRELOAD"] = str(built.resolve())
        os.execv(sys.executable, [sys.executable, *sys.argv])
    report = out / "below.jsonl"
    lines = report.read_text().splitlines() if report.exists() else []
    known = {tuple(map(str, json.loads(line)["point"])) for line in lines}
    failures = sum(bool(json.loads(line)["found"]) for line in lines)
    folder = Path(tempfile.mkdtemp()).resolve()  # TemporaryDirectory would remove it where a fork ends, too
    root = prepared(folder / "root")
    for name in commands:
        command = Below(name, root)
        cases = command.cases(per_group)
        print(f"{name}: {len(command.points)} calls, {len(cases)} points", flush=True)
        for point, fault in cases:
            key = (name, *point, fault)
            if tuple(map(str, key)) in known:
                continue
            started, command.aborted = time.perf_counter(), False
            found = command.problems(point, fault)
            line = {"point": key, "reached": found is not None, "aborted": command.aborted, "found": found or []}
            failures += bool(found)
            with report.open("a") as file:
                file.write(json.dumps(line | {"seconds": round(time.perf_counter() - started, 1)}) + "\n")
            if found:
                print(json.dumps(line), flush=True)
    shutil.rmtree(folder)
    sys.exit(failures > 0)


if __name__ == "__main__":
    tyro.cli(measure)
