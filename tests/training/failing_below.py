"""Calls of C libraries that can be made to fail, one of them at a time, by the library of faults_below.c."""

import errno
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

SOURCE = Path(__file__).with_name("faults_below.c")
"""The library that makes calls fail."""

BYTES = 2**16
"""Smallest allocation that counts, bytes: arrays and buffers, but not each of Python's objects."""


class Fault(NamedTuple):
    """The error that a call ends with. After a lasting one, nothing can be written any more."""

    number: int
    lasting: bool = False


FULL = {"ENOSPC": Fault(errno.ENOSPC, lasting=True)}
FAILED = {"EIO": Fault(errno.EIO)}
REFUSED = {"EACCES": Fault(errno.EACCES)}
MEMORY = {"ENOMEM": Fault(errno.ENOMEM)}
FAULTS = {
    "open": REFUSED,
    "create": FULL | REFUSED,
    "read": FAILED,
    "write": FULL | FAILED,
    "truncate": FAILED,
    "fsync": FAILED,
    "replace": REFUSED,
    "mkdir": FULL,
    "unlink": FAILED,
    "rmdir": FAILED,
    "load": MEMORY,
    "map": MEMORY,
    "allocate": MEMORY,
}
"""Errors of each kind of call, by name."""

RANDOM = (
    (re.compile(r"\.[0-9a-f]{16}\.part"), ".*.part"),
    (re.compile(r"(tmp|clsplat_triangulate_|clsplat_sfm_|matches_)[a-z0-9_]{8}(?=/|$)"), r"\1*"),
    (re.compile(r"photo \d"), "photo ?"),
    (re.compile(r"(?<=/)\d\.(png|db)"), r"?.\1"),
    (re.compile(r"tempfile_[A-Za-z0-9]{6}"), "tempfile_*"),
    (re.compile(r"preproc-[0-9a-f]+"), "preproc-*"),
    (re.compile(r"cache/[A-P]{2}/[A-P]+"), "cache/*"),
    (re.compile(r"cache/[A-P]{2}$"), "cache/??"),
    (re.compile(r"\[|\]"), "?"),
)
"""Parts of names of files that differ from run to run or by kernel, and patterns of fnmatch that stand for them."""


class Point(NamedTuple):
    """One call of a run: its kind, the pattern of its name, how many of the same came before it, and whether the
    program makes it ("main") or a process that it starts ("child")."""

    kind: str
    about: str
    index: int
    process: str


def library(folder: Path) -> Path | None:
    """Build the library that makes calls fail; None where that is not possible."""
    compiler = shutil.which("cc")
    if sys.platform != "linux" or compiler is None:
        return None
    built = folder / "libbelow.so"
    subprocess.run([compiler, "-O2", "-shared", "-fPIC", "-o", built, SOURCE, "-ldl"], check=True)
    return built


def environment(root: Path, scratch: Path, point: Any = None, fault: Fault | None = None) -> dict[str, str]:
    """Variables with which the library records calls, or fails one.

    Parameters
    ----------
    root : Path
        Folder of the files that count.
    scratch : Path
        Folder for the library's own files.
    """
    variables = {
        "BELOW_ROOT": str(root),
        "BELOW_BYTES": str(BYTES),
        "BELOW_LOG": "" if point else str(scratch / "log"),
        "BELOW_STATE": str(scratch / "state"),
        "TMPDIR": str(root / "tmp"),
        "POCL_CACHE_DIR": str(root / "cache"),
    }
    if point is not None and fault is not None:
        which = (point.process, point.kind, point.index, fault.number, int(fault.lasting), point.about)
        variables["BELOW_POINT"] = " ".join(map(str, which))
    return variables
