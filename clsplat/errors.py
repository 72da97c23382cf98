"""Exceptions whose message is one sentence for the user.

A wrong value: "NAME: expected X, found Y; what to do". A failed action: "cannot read X: reason; what to do".
"""

import errno
import operator
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryFile, gettempdir
from typing import SupportsIndex

PROBE = 2**22
"""Bytes that `unwritable` writes, and that must be free to build a kernel: more than a file of a driver's compiler or
an empty database of COLMAP has."""


NAMED = 3
"""Number of names that a message lists; further ones are counted."""


class ClsplatError(Exception):
    """Base class of all errors that the command line prints as one sentence, without a traceback."""


class InputError(ClsplatError, ValueError):
    """An argument or a file cannot be used; the message names it."""


class DeviceError(ClsplatError, RuntimeError):
    """There is no usable OpenCL device, its limits are exceeded, or its driver failed."""


class BuildError(DeviceError):
    """The kernels cannot be built."""


def named(names: list[str], most: int = NAMED) -> str:
    """The first names of a list, and how many more there are."""
    left_out = len(names) - most
    return ", ".join(names[:most]) + (f" and {left_out} more" if left_out > 0 else "")


def whole(name: str, value: SupportsIndex) -> int:
    """An integer of Python or NumPy as an int; an InputError names the argument."""
    try:
        return operator.index(value)
    except TypeError as error:
        raise InputError(f"{name}: expected an integer, found {value!r:.60}") from error


def new_folder(folder: Path) -> None:
    """Create a folder, with an InputError if this fails."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot create {folder}: {error.strerror or error}") from error


def unwritable(folder: Path) -> str | None:
    """The reason why no file of `PROBE` bytes can be written in a folder; None if one can be."""
    try:
        with TemporaryFile(dir=folder) as file:
            file.write(bytes(PROBE))
            file.flush()
    except OSError as error:
        limited = "; `ulimit -f` limits the size of files" if error.errno == errno.EFBIG else ""
        return f"{error.strerror or error}{limited}"
    return None


@contextmanager
def driver_errors() -> Iterator[None]:
    """Raise errors of the OpenCL driver in the block as DeviceError, such as a lost device or exhausted resources."""
    try:
        yield
    except Exception as error:
        cl = sys.modules.get("pyopencl")  # not imported: only clsplat.device and clsplat.ops may import it
        if cl is None or not isinstance(error, cl.Error):
            raise
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        if getattr(error, "code", None) == cl.status_code.BUILD_PROGRAM_FAILURE:
            raise BuildError(_unbuilt(reason, log=str(error))) from error
        raise DeviceError(f"the OpenCL driver failed: {reason}") from error


def _unbuilt(reason: str, log: str) -> str:
    """Sentence about kernels that a driver could not build; its compiler needs space for files."""
    if "unknown target CPU" in log:
        return (
            "cannot build the kernels: this processor is newer than the OpenCL driver, whose compiler does not know "
            "it; install a newer driver (`conda install -c conda-forge pocl`, or the system's package)"
        )
    caches = [os.environ.get(name) for name in ("POCL_CACHE_DIR", "XDG_CACHE_HOME")]
    for folder in (Path(gettempdir()), Path.home() / ".cache", *(Path(cache) for cache in caches if cache)):
        if folder.is_dir() and (problem := unwritable(folder)):
            return f"cannot build the kernels: the driver's compiler writes files, and {folder} takes none: {problem}"
    return f"cannot build the kernels: {reason}"
