"""The command line: choose a command of `clsplat.commands`, run it, print errors as one sentence."""

import atexit
import os
import select
import signal
import sys
import threading
import traceback
import warnings
from dataclasses import dataclass
from importlib.metadata import version
from typing import Annotated, NoReturn, get_args

import tyro

from clsplat.bench.bench_commands import Captures, Chart, Kernels, Knobs, Quality, Stability, Viewer
from clsplat.bench.field_command import Fields
from clsplat.commands import console
from clsplat.commands.arguments import parsed, unknown
from clsplat.commands.blockwise import Block
from clsplat.commands.compact import Compact
from clsplat.commands.console import Terminated, warn
from clsplat.commands.demo import Demo
from clsplat.commands.files import Export, Frames, Sfm
from clsplat.commands.info import Info
from clsplat.commands.listing import Devices
from clsplat.commands.meshes import Mesh
from clsplat.commands.rendering import Eval, Render
from clsplat.commands.train import Train
from clsplat.commands.viewing import View
from clsplat.errors import ClsplatError, InputError, driver_errors
from clsplat.ranges import check

BENCHMARKS = (
    Annotated[Kernels, tyro.conf.subcommand("kernels")]
    | Annotated[Knobs, tyro.conf.subcommand("knobs")]
    | Annotated[Quality, tyro.conf.subcommand("quality")]
    | Annotated[Fields, tyro.conf.subcommand("fields")]
    | Annotated[Captures, tyro.conf.subcommand("captures")]
    | Annotated[Chart, tyro.conf.subcommand("chart")]
    | Annotated[Stability, tyro.conf.subcommand("stability")]
    | Annotated[Viewer, tyro.conf.subcommand("viewer")]
)


@dataclass(frozen=True)
class Bench:
    """Run benchmarks on this machine."""

    what: Annotated[BENCHMARKS, tyro.conf.arg(name="")]
    """Benchmark to run."""

    def run(self) -> None:
        """Run the command."""
        self.what.run()


DESCRIPTION = """3D Gaussian Splatting on any OpenCL device. COMMAND --help shows the common settings, and --help-all
shows all. Every command accepts -q (--quiet: only warnings and errors) and -v (--verbose: also messages of structure
from motion and of the driver's compiler, and tracebacks of errors). --version prints the version."""

COMMANDS = (
    Train | View | Export | Render | Mesh | Eval | Compact | Info | Frames | Sfm | Block | Devices | Demo | Bench
)


def set_loudness(arguments: list[str]) -> list[str]:
    """Apply -q and -v, which every command accepts, and return the other arguments."""
    quiet, verbose = ({"-q", "--quiet"}.intersection(arguments), {"-v", "--verbose"}.intersection(arguments))
    if quiet and verbose:
        raise InputError("-q and -v: expected one of them, found both")
    console.loudness = "quiet" if quiet else "verbose" if verbose else "normal"
    if console.loudness == "quiet":
        os.environ["TQDM_DISABLE"] = "1"  # tqdm reads it on import
    if console.loudness == "verbose":
        os.environ["PYOPENCL_COMPILER_OUTPUT"] = "1"
    return [argument for argument in arguments if argument not in quiet | verbose]


def main(arguments: list[str] | None = None) -> None:
    """Run the program ``clsplat``; print errors that the user can correct as one sentence and exit with status 2."""
    warnings.showwarning = lambda message, *_, **__: warn(f"warning: {message}")
    if os.environ.get("NO_COLOR"):  # no-color.org
        tyro._experimental_options["ansi_codes"] = False
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, terminate)
    try:
        run(sys.argv[1:] if arguments is None else arguments)
    except (ClsplatError, OSError) as error:
        if isinstance(error, BrokenPipeError) and reader_left():
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes it once more at its end
            sys.exit(1)
        if console.loudness == "verbose":
            traceback.print_exc()
        if isinstance(error, ClsplatError):
            warn(f"clsplat: {error}")
        else:  # an OSError that no function has translated, such as a full disk while a log is written
            warn(f"clsplat: cannot read or write {error.filename or 'a file'}: {error.strerror or error}")
        sys.exit(2)
    except MemoryError as error:
        if console.loudness == "verbose":
            traceback.print_exc()
        reason = f" ({error})" if str(error) else ""
        warn(f"clsplat: this machine has not enough memory{reason}; use smaller photos or fewer Gaussians")
        sys.stdout.flush()
        # A driver that met the end of the memory may still hold its locks, for which its own clean-up then waits for
        # ever, and the release of an array as well: the error, whose traceback refers to arrays, is kept.
        atexit.register(end, error)
        sys.exit(2)
    except Terminated:
        terminate()
    except KeyboardInterrupt:
        warn("clsplat: interrupted")
        sys.exit(130)


def end(kept: MemoryError) -> NoReturn:
    """End the process without its clean-up; `kept` is not released before."""
    os._exit(2)


def reader_left() -> bool:
    """Whether standard output is a pipe whose reader has ended, as ``head`` does."""
    if not hasattr(select, "poll"):  # Windows, where the error is another one
        return False
    poll = select.poll()
    poll.register(sys.stdout, 0)
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))


def terminate(*_: object) -> NoReturn:
    """End the program after its clean-up, as Ctrl-C does; its status is that of a process that SIGTERM ended."""
    warn("clsplat: terminated")
    sys.exit(128 + signal.SIGTERM)


def run(arguments: list[str]) -> None:
    """Parse the arguments and run the command."""
    arguments = set_loudness(arguments) or ["--help"]
    name, rest = arguments[0], arguments[1:]
    if name == "--version":
        print(f"clsplat {version('clsplat')}")
        return
    commands = {command.__name__.lower(): command for command in get_args(COMMANDS)}
    if name not in commands:
        if not name.startswith("-"):
            raise unknown(name, list(commands))
        parsed(COMMANDS, "clsplat", arguments, description=DESCRIPTION)
    kind, prog = commands[name], f"clsplat {name}"
    command = parsed(kind, prog, rest)
    start = command.base() if hasattr(command, "base") else None
    if start is not None:  # parsed again, with other defaults, which flags then override
        command = parsed(kind, prog, rest, start)
    check(command)
    with driver_errors():
        command.run()
