"""Blocks on the devices of this machine: one process for each device of the same kind."""

import json
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, TYPE_CHECKING, NamedTuple

from clsplat.blocks.block import result_of, train_block
from clsplat.blocks.jobs import read_job
from clsplat.dataset.sfm.processes import EXIT_WITH_PARENT
from clsplat.errors import ClsplatError

if TYPE_CHECKING:
    from clsplat.device import Device

POLL = 0.1
"""Seconds between two looks at the processes."""

TRAIN_ON = """
import json
sys.path[:] = json.loads(sys.argv[1])
from clsplat.blocks.local import train_on
train_on(sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
"""
"""Program that runs `train_on` with the module search path of the process that started it."""


class _Running(NamedTuple):
    """A process that trains a block, what it writes to its standard error, and what ends it and closes its files."""

    job: Path
    process: subprocess.Popen[bytes]
    errors: IO[bytes]
    end: ExitStack


def devices_like(device: "Device") -> list[int]:
    """Numbers, among all OpenCL devices, of those with the label of a device: they compute the same bits."""
    from clsplat.device import device_label, list_devices

    return [number for number, other in enumerate(list_devices()) if device_label(other) == device.label]


def run_on_devices(jobs: list[Path], devices: list[int], tell: Callable[[str], None]) -> None:
    """Train the blocks that have no result, each in a separate process, one at a time on each device.

    The processes end with this one. A block that has been interrupted continues from its last checkpoint.

    Parameters
    ----------
    jobs : list of Path
    devices : list of int
        As `devices_like` returned them.
    tell : callable
        Called with a sentence when a block is done.

    Raises
    ------
    ClsplatError
        If the training of a block fails; the others are stopped.
    """
    waiting = [job for job in jobs if not result_of(job).exists()]
    total, done = len(waiting), 0
    running: dict[int, _Running] = {}
    with ExitStack() as stack:
        while waiting or running:
            for number, device in enumerate(devices):
                if waiting and number not in running:
                    running[number] = _started(waiting.pop(0), device, len(devices), stack)
            time.sleep(POLL)
            ended = [number for number, each in running.items() if each.process.poll() is not None]
            for number in ended:
                job, process, errors, end = running.pop(number)
                with end:
                    if process.returncode != 0:
                        raise ClsplatError(f"block {job.stem}: {_reason(process.returncode, errors)}")
                done += 1
                tell(f"blocks: {done} of {total} done, the last by device {number + 1} of {len(devices)}")


def _started(job: Path, device: int, beside: int, stack: ExitStack) -> _Running:
    end = stack.enter_context(ExitStack())
    errors = end.enter_context(TemporaryFile())
    program = EXIT_WITH_PARENT + TRAIN_ON
    arguments = [json.dumps(sys.path), str(job.resolve()), str(device), str(beside)]
    command = [sys.executable, "-I", "-c", program, *arguments]
    process = end.enter_context(subprocess.Popen(command, stdin=subprocess.PIPE, stderr=errors))
    end.callback(_ended, process)
    return _Running(job, process, errors, end)


def _ended(process: subprocess.Popen[bytes]) -> None:
    """End a process, if it still runs."""
    process.kill()
    process.wait()  # Popen itself does not wait after Ctrl-C


def _reason(status: int, errors: IO[bytes]) -> str:
    """Reason of the failure of a process: its status, and the last line that it wrote."""
    errors.seek(0)
    lines = errors.read().decode(errors="replace").strip().splitlines()
    return f"its process ended with status {status}{': ' if lines else ''}{''.join(lines[-1:])}"


def train_on(job_file: str, number: int, beside: int) -> None:
    """Train a block on the OpenCL device of a number; run by each of the `beside` processes of `run_on_devices`."""
    from clsplat.device import Device, list_devices
    from clsplat.training.preparation import photo_memory

    limit = photo_memory(read_job(Path(job_file)).config)
    train_block(job_file, device=Device(list_devices()[number], memory_limit=limit), beside=beside)
