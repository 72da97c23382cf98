"""Blocks on a cluster of dask.distributed: one task per block, one block per device at a time."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from clsplat.blocks.block import result_of, train_block
from clsplat.blocks.jobs import read_job
from clsplat.blocks.transport import Desk, train_from
from clsplat.errors import ClsplatError, InputError, driver_errors
from clsplat.scene import View

RESOURCE = "CL"
"""Resource that a worker declares for each of its OpenCL devices, as in ``dask worker --resources "CL=1"``."""

RETRIES = 3
"""Times that a block is trained again elsewhere when its worker dies or raises an error; it continues from its last
checkpoint."""

CACHE = "clsplat"
"""Folder of a worker that shares none, in its own one (``dask worker --local-directory``), which dask removes."""


def run_on_cluster(address: str, jobs: list[Path], views: list[View], tell: Callable[[str], None]) -> None:
    """Train the blocks that have no result on the workers of a scheduler.

    A task is named by the job's digest and its result is a file, so that it does not matter who trains a block, when,
    and how often it was tried. A worker that sees the job and the dataset under their paths works there. Another one
    gets its data through the scheduler (`clsplat.blocks.transport`).

    Parameters
    ----------
    address : str
        Such as tcp://host:8786.
    jobs : list of Path
        All in one folder.
    views : list of View
        The training photos, for workers without a shared folder.
    tell : callable
        Called with a sentence when a block is done.

    Raises
    ------
    InputError
        If dask.distributed is not installed, there is no scheduler or it is lost, or a worker has another folder of
        the same path.
    ClsplatError
        If the training of a block fails on a worker, or its workers die; when all others have ended.
    """
    try:
        from distributed import CancelledError, Client, KilledWorker, as_completed
    except ImportError as error:
        raise InputError(
            "--scheduler: expected the package distributed, found none; pip install 'clsplat[cluster]'"
        ) from error
    try:
        client = Client(address)
    except (OSError, ValueError) as error:  # TimeoutError is an OSError
        raise InputError(f"--scheduler: expected a scheduler of dask at {address}, found none: {error}") from error
    waiting = [job.resolve() for job in jobs if not result_of(job).exists()]
    with client, Desk(client, jobs[0].parent, views) as desk:
        _tell_missing(client, tell)
        how: dict[str, Any] = {"resources": {RESOURCE: 1}, "retries": RETRIES}
        tasks = {client.submit(_train, str(job), desk.name, key=f"clsplat-{job.stem}", **how): job for job in waiting}
        failures: list[str] = []
        done = 0
        for task in as_completed(list(tasks)):
            try:
                worker = task.result()
            except CancelledError as error:
                raise InputError(
                    f"--scheduler: lost the scheduler at {address}; finished blocks are kept: start it and its "
                    "workers again, and use --resume"
                ) from error
            except (ClsplatError, KilledWorker) as error:  # the others go on
                failures.append(_why(tasks[task], error))
                continue
            if not result_of(tasks[task]).exists():
                raise InputError(
                    f"{tasks[task].parent}: expected a folder that workers share or do not have, found no result "
                    f"after {worker} had written one; choose another folder with -o"
                )
            done += 1
            tell(f"blocks: {done} of {len(tasks)} done, the last by {worker}")
    if failures:
        raise ClsplatError(
            f"{failures[0]}; {len(failures)} of {len(tasks)} blocks have failed, the others are kept: --resume "
            "trains what is missing"
        )


def _why(job: Path, error: Exception) -> str:
    """Sentence on the failure of a block."""
    if isinstance(error, ClsplatError):
        return f"block {job.stem}: {error}"
    return f"block {job.stem}: expected a worker that trains it, found that each worker died"


def _train(job: str, desk: str) -> str:
    """Train a block on a worker; return the name of the worker."""
    from distributed import get_worker

    worker = get_worker()
    try:
        with driver_errors():
            if _is_here(Path(job)):
                train_block(job)
            else:
                train_from(desk, Path(job).name, Path(worker.local_directory) / CACHE)
    except Exception as error:  # any: errors of drivers and of other packages cannot always be sent
        raise ClsplatError(f"worker {worker.name}: {_sentence(error)}") from None
    return str(worker.name)


def _sentence(error: Exception) -> str:
    if isinstance(error, ClsplatError):
        return str(error)
    if isinstance(error, OSError):  # one that no function has translated, such as a full disk while a log is written
        return f"cannot read or write {error.filename or 'a file'}: {error.strerror or error}"
    return repr(error)


def _is_here(job: Path) -> bool:
    """Whether the worker sees a job and its dataset: it shares the folders."""
    return job.exists() and Path(read_job(job).data).exists()


def _tell_missing(client: Any, tell: Callable[[str], None]) -> None:
    """Say that blocks wait for workers, if no worker declares a device."""
    workers = client.scheduler_info(n_workers=-1)["workers"].values()
    if not any(worker.get("resources", {}).get(RESOURCE) for worker in workers):
        tell(
            f"blocks: {len(workers)} workers, none of which declares a device; blocks wait for workers that were "
            f'started with: dask worker SCHEDULER --resources "{RESOURCE}=1" --nthreads 1'
        )
