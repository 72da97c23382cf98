"""Commands in this process, as they run in one of their own, where nothing but their work counts."""

import hashlib
import os
import shutil
import signal
import sys
import tempfile
import threading
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from math import inf
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import tyro

from clsplat import cli
from clsplat.dataset.sfm import reconstruction
from clsplat.training import loop, recorder

SOLVED = "solved"
"""Folder of the model that structure from motion finds, each time without its seconds of computation."""

HANG = 30.0
"""Time after which a command counts as hanging, s; it takes less than one."""


class Hung(BaseException):
    """The command did not end."""


def status_of(arguments: list[str]) -> int:
    """The status that the command line ends with; 1, with a traceback, for an exception that it does not catch."""
    try:
        cli.main(arguments)
    except SystemExit as exit_:
        return int(exit_.code or 0)
    except (Exception, Hung):
        traceback.print_exc()
        return 1
    return 0


@contextmanager
def outside(root: Path, seconds: float = HANG) -> Iterator[list[str]]:
    """Run the block in a folder as a process of its own would, at a clock that stands still; yields stray exceptions.

    Arguments are parsed once, and charts are blank: both take longer than all the rest.
    """
    stray: list[str] = []
    parse = tyro.cli

    def parse_once(*arguments: Any, args: list[str], **named: Any) -> Any:
        typed = (named["prog"], *args)
        if typed not in PARSED:
            PARSED[typed] = parse(*arguments, args=args, **named)
        return PARSED[typed]

    def hang(*_: object) -> None:
        raise Hung

    def solved(work: Path, *_: object) -> int:
        shutil.copytree(root / SOLVED / "sparse" / "0", work / "sparse" / "0")
        return len(os.listdir(root / "photos"))

    def blank(self: Any, file: Any, **_: Any) -> None:
        file.write(bytes(20000))

    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        patch.chdir(root)
        patch.setattr(tempfile, "tempdir", str(root / "tmp"))
        patch.setattr(tyro, "cli", parse_once)
        patch.setattr("matplotlib.figure.Figure.savefig", blank)
        if (root / SOLVED).is_dir():  # pycolmap takes seconds, and threads of its own
            patch.setattr(reconstruction, "_solved", solved)
        for module in (loop, recorder):
            patch.setattr(module, "time", SimpleNamespace(perf_counter=lambda: 0.0))
        patch.setattr(threading, "excepthook", lambda about: stray.append(f"{about.exc_type}: {about.exc_value}"))
        patch.setattr(sys, "unraisablehook", lambda about: stray.append(f"{about.exc_value!r} {about.object!r}"))
        signal.signal(signal.SIGALRM, hang)
        if seconds < inf:
            signal.setitimer(signal.ITIMER_REAL, seconds)
        try:
            yield stray
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
            for number, handler in handlers.items():
                signal.signal(number, handler)


PARSED: dict[tuple[str, ...], Any] = {}
"""Commands by their arguments."""


def digest(path: Path) -> str:
    """Digest of a file's bytes."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
