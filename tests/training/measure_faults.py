"""Faults at every call: a command runs again and again, and each time another one of its calls fails.

``make faults``, which sets the path of the test modules. The report, faults.json, has the number of points by command
and kind of call, and what went wrong.
"""

import io
import json
import os
import re
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, NamedTuple

import tyro
from cli_runs import write_dataset
from failing_calls import FAULTS, Calls, Point, is_json, watched
from fault_commands import COMMANDS, PHOTOS, TRAIN, opens_device, stays
from filelock import FileLock, Timeout
from lone_commands import SOLVED, digest, outside, status_of
from PIL import Image
from textured_corner import CONFIG, take_photos

from clsplat.atomic import PART
from clsplat.commands.console import Out
from clsplat.dataset.sfm.reconstruction import reconstruct
from clsplat.renderer import opened_device
from clsplat.resuming import CHECKPOINT
from clsplat.run_log import LOG
from clsplat.training.run_folder import LOCK


class Ended(NamedTuple):
    """How a command ended: its status, what it printed, and exceptions that nothing caught."""

    status: int
    printed: str
    stray: list[str]


class Command:
    """A command in a folder of its own, and what it does when nothing fails.

    Parameters
    ----------
    name : str
        One of `commands`.
    root : Path
        Folder, with the dataset and the scene that `prepared` makes.
    """

    commands = COMMANDS
    faults = FAULTS

    def __init__(self, name: str, root: Path):
        self._arguments, self._root, self._out = self.commands[name], root, root / "out"
        self._trains = self._arguments[0] == "train"
        self._resumed: set[frozenset[tuple[str, str]]] = set()
        self._versions: set[tuple[str, str]] = set()
        self._clear()
        calls = Calls()
        ended = self._run(calls, fresh=True)
        assert ended.status == 0 and not ended.stray, ended
        self.points, self._whole = calls.points, self._files()
        self._log = (self._out / LOG).read_text().splitlines() if self._trains else []

    def cases(self, per_kind: int | None = None) -> list[tuple[Point, str]]:
        """Calls and their errors: all of them, or at most so many of each group, evenly spaced."""
        groups: dict[tuple[str, str], list[Point]] = {}
        for point in self.points:
            for fault in self.faults[point.kind]:
                groups.setdefault((self.group(point), fault), []).append(point)
        return [
            (points[(2 * i + 1) * len(points) // (2 * count)], fault)
            for (_, fault), points in groups.items()
            for count in [min(per_kind or len(points), len(points))]
            for i in range(count)
        ]

    def group(self, point: Point) -> str:
        """The group of a call for `cases`: its kind."""
        return point.kind

    def problems(self, point: Point, fault: str) -> list[str] | None:
        """What is wrong after a call has failed, and after the run that follows; None if the call was not reached."""
        for fresh in sorted({opens_device(point), True}):  # a device that stays open keeps buffers of earlier runs
            self._clear()
            calls = Calls(point, self.faults[point.kind][fault])
            ended = self._run(calls, fresh=fresh)
            if calls.failed:
                break
        else:
            return None
        found = self._wrong_end(ended, point) + self._wrong_files(point) + self._held()
        whole = ended.status == 0
        if whole and any(not stays(name, point) for name in self._differing()):
            found.append(f"ended well, with other files: {self._differing()}")
        state = self._state()
        if not found and not self._done(whole) and state not in self._resumed:
            found += self._wrong_again()
            self._resumed.add(state)
        return found

    def _state(self) -> frozenset[tuple[str, str]]:
        """What a run leaves that the next one may depend on."""
        return frozenset(self._files().items())

    def _done(self, whole: bool) -> bool:
        """Whether no further run is needed to know that a run left nothing wrong; `whole` if it ended well."""
        return whole

    def _wrong_again(self) -> list[str]:
        """What is wrong after the command ran again without a fault."""
        resume = ["--resume"] if self._trains and (self._out / CHECKPOINT).exists() else []
        ended = self._run(Calls(), resume)
        found = [f"again: {what}" for what in self._held()]
        if ended.status != 0 or ended.stray:
            found.append(f"again: ended with {ended.status}: {ended.printed[-2000:]} {ended.stray}")
        elif self._files() != self._whole:
            found.append(f"again: other files: {self._differing()}")
        return found

    def _clear(self) -> None:
        for folder in (self._out, self._root / "tmp"):
            shutil.rmtree(folder, ignore_errors=True)
        (self._root / "tmp").mkdir()
        if not self._trains:
            self._out.mkdir()

    def _run(self, calls: Calls, more: Iterable[str] = (), fresh: bool = False) -> Ended:
        if fresh:
            opened_device.cache_clear()

        def replaced(path: Path) -> None:
            if not calls.failed:
                self._versions.update(self._versions_of(path))

        with outside(self._root) as stray, watched(self._root, calls, replaced):
            printed = io.StringIO()
            with redirect_stderr(printed), redirect_stdout(printed):
                status = status_of([*self._arguments, *more])
        return Ended(status, printed.getvalue(), stray)

    def _versions_of(self, path: Path) -> Iterator[tuple[str, str]]:
        """Names and digests of the outputs in a file or folder that has just been put in its place."""
        if path.resolve().is_relative_to(self._out):
            files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
            yield from ((self._name(file), digest(file)) for file in files)

    def _name(self, path: Path) -> str:
        return str(path.resolve().relative_to(self._out.resolve()))

    def _files(self) -> dict[str, str]:
        files = [path for path in self._out.rglob("*") if path.is_file() and "tensorboard" not in path.parts]
        return {self._name(path): digest(path) for path in files}

    def _differing(self) -> list[str]:
        now = self._files()
        return sorted(name for name in {*now, *self._whole} if now.get(name) != self._whole.get(name))

    def _wrong_end(self, ended: Ended, point: Point) -> list[str]:
        sentences = [line for line in ended.printed.splitlines() if line.startswith("clsplat: ")]
        found = [f"stray: {what}" for what in ended.stray]
        if re.search("Traceback|Exception", ended.printed):
            found.append(f"printed {ended.printed[-2000:]}")
        if ended.status == 0:
            return found
        if point.kind in ("unlink", "rmdir") and ".db-" not in point.about:  # SQLite commits by removing its journal
            found.append(f"ended because a file could not be removed: {sentences}")
        if ended.status != 2 or len(sentences) != 1:
            found.append(f"status {ended.status}, {sentences}: {ended.printed[-2000:]}")
        elif "a file:" in sentences[0] and point.kind != "read":  # the system names no file that is open
            found.append(f"names no file: {sentences[0]}")
        return found

    def _wrong_files(self, point: Point) -> list[str]:
        """Files that the run without a fault never wrote: half of one, or one of a temporary name."""
        removal = point.kind in ("unlink", "rmdir", "list")
        unlocked = point.kind == "lock"  # another process may hold the file: it stays
        found = []
        for name, content in self._files().items():
            last = Path(name).name
            if name == LOG:
                # The last line may be cut off, and a line after a write that failed.
                lines = (self._out / LOG).read_text().splitlines()
                if [line for line in lines if is_json(line)] != self._log[: sum(map(is_json, lines))]:
                    found.append(f"{name}: {lines}")
            elif PART.fullmatch(last) or last.startswith(LOCK):
                if not removal and not (unlocked and last == LOCK):
                    found.append(f"{name} is left")
            elif (name, content) not in self._versions and not stays(name, point):
                found.append(f"{name} is not whole")
        left = [path.name for path in (self._root / "tmp").iterdir()]
        if left and not removal and not point.about.startswith("tmp"):
            found.append(f"temporary files are left: {left}")
        return found

    def _held(self) -> list[str]:
        """Whether the folder, or a file in it, is still held."""
        found = []
        if sys.platform == "linux":
            numbers = [Path("/proc/self/fd") / number for number in os.listdir("/proc/self/fd")]
            targets = [os.readlink(number) for number in numbers if os.path.lexists(number)]
            found += [f"{path} is open" for path in targets if path.startswith(str(self._root))]
        if self._out.is_dir() and self._trains:
            lock = FileLock(self._out / LOCK, blocking=False)
            try:
                lock.acquire()
            except Timeout:
                found.append("the folder is locked")
            else:
                lock.release()
                (self._out / LOCK).unlink(missing_ok=True)
        return found


def prepared(root: Path) -> Path:
    """Write a dataset, and a scene of a few Gaussians that is trained on it, to a folder."""
    write_dataset(root / "data", PHOTOS)
    (root / "tmp").mkdir()
    with outside(root):
        status_of([*TRAIN[:3], "first", TRAIN[4], "10", *TRAIN[10:12], "--init.no-triangulate"])
    (root / "first" / "scene.ply").rename(root / "scene.ply")
    shutil.rmtree(root / "first")
    (root / "photos").mkdir()
    for k, photo in enumerate(take_photos(0)):
        Image.fromarray(photo).save(root / "photos" / f"photo {k}.png")
    reconstruct(root / "photos", CONFIG, root / SOLVED)
    return root


def measure(out: Out, commands: tuple[str, ...] = tuple(COMMANDS), every: int = 1) -> None:
    """Fail each call of the commands in turn, or only each so many-th."""
    report: dict[str, Any] = {}
    failures = 0
    with tempfile.TemporaryDirectory() as folder:
        root = prepared(Path(folder).resolve())
        for name in commands:
            started = time.perf_counter()
            command = Command(name, root)
            tried: Counter[str] = Counter()
            unreached, wrong = [], []
            cases = command.cases()[::every]
            for number, (point, fault) in enumerate(cases):
                found = command.problems(point, fault)
                if found is None:
                    unreached.append([*point, fault])
                else:
                    tried[f"{point.kind} {fault}"] += 1
                if found:
                    wrong.append({"point": [*point, fault], "found": found})
                    print(json.dumps(wrong[-1]), flush=True)
                if number % 200 == 0:
                    print(f"{name}: {number} of {len(cases)}, {time.perf_counter() - started:.0f} s", flush=True)
            report[name] = {
                "calls": len(command.points),
                "points": tried.total(),
                "by kind": dict(sorted(tried.items())),
                "unreached": unreached,
                "failures": wrong,
                "seconds": round(time.perf_counter() - started),
            }
            failures += len(wrong)
            out.mkdir(parents=True, exist_ok=True)
            (out / "faults.json").write_text(json.dumps(report, indent=1) + "\n")
    sys.exit(failures > 0)


if __name__ == "__main__":
    tyro.cli(measure)
