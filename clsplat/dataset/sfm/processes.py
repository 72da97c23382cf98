"""Processes for COLMAP: what ends one of them, such as a full disk or too little memory, becomes an error here."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from clsplat.errors import ClsplatError, InputError, unwritable

EXIT_WITH_PARENT = """
import os, signal, sys, threading
signal.signal(signal.SIGINT, signal.SIG_IGN)
threading.Thread(target=lambda: (sys.stdin.read(), os._exit(1)), daemon=True).start()
"""
"""First lines of each program. The program exits when the process that started it ends for any reason, and leaves
Ctrl+C to that process."""

ANSWER = """
import json
sys.path[:] = json.loads(sys.argv[1])
from clsplat.dataset.sfm.processes import answer
answer(sys.argv[2], sys.argv[3])
"""
"""Program that runs `answer` with the module search path of the process that started it."""

ARGUMENTS = "arguments.json"
"""File in a working folder with the arguments of the function that `apart` calls."""


@contextmanager
def child(
    program: str, *arguments: str, stdout: int | None = None, stderr: int | None = None
) -> Iterator["subprocess.Popen[str]"]:
    """Run a Python program in a process that does not outlive the context."""
    command = [sys.executable, "-I", "-c", EXIT_WITH_PARENT + program, *arguments]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=stdout, stderr=stderr, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def apart(what: str, function: str, work: Path, **arguments: Any) -> Any:
    """Call a function in a separate process, because COLMAP ends its process if it cannot continue.

    Parameters
    ----------
    what : str
        The purpose, for errors: "cannot `what`: ...".
    function : str
        "MODULE:NAME". It is called with `work` and the arguments.
    work : Path
        Folder for its files.
    **arguments
        They and the result can be written as JSON.

    Raises
    ------
    InputError
        If the function raises one.
    MemoryError
        If the function runs out of memory and says so.
    ClsplatError
        If it fails in another way, or its process ends without an answer.
    """
    try:
        (work / ARGUMENTS).write_text(json.dumps(arguments), encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot {what}: cannot write to {work.parent}: {error.strerror or error}") from error
    with child(ANSWER, json.dumps(sys.path), function, str(work), stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        said = process.stdout.read()
        status = process.wait()
    outcome, value = json.loads(said) if status == 0 else ("ended", how_it_ended(status))
    if outcome == "result":
        return value
    if outcome == "refused":
        raise InputError(value)
    if outcome == "memory":
        raise MemoryError(value)
    if problem := unwritable(work):
        value = f"{work.parent} takes no files: {problem}"
    elif outcome == "failed":
        value = f"COLMAP, whose files were in {work.parent}, reports: {value}"
    raise ClsplatError(f"cannot {what}: {value}")


def how_it_ended(status: int) -> str:
    """Sentence on the end of a process that gave no answer."""
    if status >= 0:
        return f"the process of COLMAP ended with status {status}; its output is above"
    name = signal.Signals(-status).name
    killed = "; the system ends processes so where there is not enough memory" if name == "SIGKILL" else ""
    return f"the process of COLMAP was ended by {name}{killed or '; its output is above'}"


def answer(function: str, work: str) -> None:
    """Call a function as `apart` asks, and print what came of it as JSON; run by the process that it starts."""
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what COLMAP prints is no answer
    module, name = function.split(":")
    try:
        arguments = json.loads((Path(work) / ARGUMENTS).read_text(encoding="utf-8"))
        outcome = "result", getattr(import_module(module), name)(Path(work), **arguments)
    except MemoryError as error:
        outcome = "memory", str(error)
    except ClsplatError as error:
        outcome = "refused", str(error)
    except Exception as error:  # COLMAP's errors are of many kinds
        outcome = "failed", str(error) or repr(error)
    out.write(json.dumps(outcome))
    out.close()
    os._exit(0)  # COLMAP's own clean-up may fail where the disk or the memory has
