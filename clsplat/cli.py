"""The command line: a command of `clsplat.commands` each; errors in one sentence."""

import sys
import warnings
from dataclasses import dataclass, replace
from typing import Annotated

import tyro

from clsplat.bench.commands import Chart, Kernels, Knobs, Quality, Stability
from clsplat.commands.compact import Compact
from clsplat.commands.console import say
from clsplat.commands.files import Devices, Export, Frames, Sfm
from clsplat.commands.info import Info
from clsplat.commands.pictures import Eval, Render
from clsplat.commands.training import Demo, Train
from clsplat.commands.viewing import View
from clsplat.errors import ClsplatError, driver_errors

BENCHMARKS = (
    Annotated[Kernels, tyro.conf.subcommand("kernels")]
    | Annotated[Knobs, tyro.conf.subcommand("knobs")]
    | Annotated[Quality, tyro.conf.subcommand("quality")]
    | Annotated[Chart, tyro.conf.subcommand("chart")]
    | Annotated[Stability, tyro.conf.subcommand("stability")]
)


@dataclass(frozen=True)
class Bench:
    """Measure this installation on this machine."""

    what: Annotated[BENCHMARKS, tyro.conf.arg(name="")]
    """What to measure."""

    def run(self) -> None:
        """Run the command."""
        self.what.run()


COMMANDS = Devices | Frames | Sfm | Train | Eval | Render | View | Export | Compact | Info | Demo | Bench


def main(arguments: list[str] | None = None) -> None:
    """Entry point of ``clsplat``: errors that are the user's to mend print one sentence and exit with 2."""
    warnings.showwarning = lambda message, *_, **__: say(f"warning: {message}")
    arguments = sys.argv[1:] if arguments is None else arguments
    command = tyro.cli(
        COMMANDS, prog="clsplat", args=arguments, description="3D Gaussian Splatting on any OpenCL device."
    )
    try:
        if isinstance(command, Train) and (base := command.base()):
            # Read again: flags are told from defaults by what they are put into.
            start = replace(command, settings=base)
            command = tyro.cli(Train, prog="clsplat train", args=arguments[1:], default=start)
        with driver_errors():
            command.run()
    except ClsplatError as error:
        say(f"clsplat: {error}")
        sys.exit(2)
    except OSError as error:  # what no reader or writer has put in words: a disk that fills up under a log, say
        say(f"clsplat: {error.filename or 'input or output'}: {error.strerror or error}")
        sys.exit(2)
    except KeyboardInterrupt:
        say("clsplat: interrupted")
        sys.exit(130)
