"""Schedulers that end, slow workers and full disks: a sentence or the same bytes, and no result is lost."""

import errno
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from small_plan import Planned, plan

from clsplat.blocks.block import result_of, train_block
from clsplat.blocks.cluster import run_on_cluster
from clsplat.blocks.transport import Desk
from clsplat.device import Device
from clsplat.errors import ClsplatError, InputError

distributed = pytest.importorskip("distributed", reason="the extra `cluster` is not installed")

# dask's processes outlive their sockets and event loops by a moment when they end.
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")


@contextmanager
def workers(count: int, *preload: str) -> Iterator[Any]:
    """A cluster of this machine, each of whose workers runs a program first."""
    settings = {"threads_per_worker": 1, "dashboard_address": None, "resources": {"CL": 1}, "preload": list(preload)}
    with distributed.LocalCluster(n_workers=count, processes=True, **settings) as cluster:
        yield cluster


def run(address: str, planned: Planned) -> None:
    run_on_cluster(address, planned.jobs, planned.scene.train, lambda text: None)


@pytest.fixture
def expected(dataset: Path, device: Device, tmp_path: Path) -> list[bytes]:
    alone = plan(dataset, device, tmp_path / "alone", 3)
    return [train_block(job, alone.scene.train, device).read_bytes() for job in alone.jobs]


APART = """
from clsplat.blocks import cluster, transport
cluster._is_here = lambda job: False
"""
"""Makes a worker share no folder."""

SLOW = """
import time
def ask(self, *request, ask=transport.Cache._ask):
    time.sleep(0.1)
    return ask(self, *request)
def train(self, *arguments, train=transport.train_block):
    time.sleep(2)
    return train(self, *arguments)
transport.Cache._ask, transport.train_block = ask, train
"""
"""Makes a worker several times slower than the others, in what it asks for and in what it trains."""


def started(program: str, folder: Path, *arguments: str) -> subprocess.Popen[bytes]:
    """A scheduler or a worker in a process of its own."""
    command = [sys.executable, "-P", "-m", f"distributed.cli.dask_{program}", *arguments, "--no-dashboard"]
    return subprocess.Popen(command, cwd=folder, stderr=subprocess.DEVNULL)


def worker(address: str, folder: Path, *options: str) -> subprocess.Popen[bytes]:
    return started("worker", folder, address, "--nthreads", "1", "--resources", "CL=1", "--no-nanny", *options)


@contextmanager
def ending(*processes: subprocess.Popen[bytes]) -> Iterator[None]:
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


@pytest.mark.slow
def test_a_slow_worker_changes_no_bit(dataset: Path, device: Device, tmp_path: Path, expected: list[bytes]) -> None:
    planned = plan(dataset, device, tmp_path / "run", 3)
    with workers(1, APART) as cluster, distributed.Client(cluster) as client:
        with ending(worker(cluster.scheduler_address, tmp_path, "--preload", APART + SLOW)):
            client.wait_for_workers(2, timeout=60)
            run(cluster.scheduler_address, planned)
    assert [result_of(job).read_bytes() for job in planned.jobs] == expected


IMPATIENT = """
transport.PATIENCE = 1
"""


def test_an_answer_that_comes_too_late_is_asked_for_again(
    planned: Planned, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The late answer is not taken for another one."""
    photo, asked = Desk._photo, []

    def late(self: Desk, *about: Any) -> Any:
        asked.append(about)
        time.sleep(3 if len(asked) == 4 else 0)
        return photo(self, *about)

    monkeypatch.setattr(Desk, "_photo", late)
    with workers(1, APART + IMPATIENT) as cluster:
        run(cluster.scheduler_address, planned)
    found = [result_of(job).read_bytes() for job in planned.jobs]
    assert asked.count(asked[3]) >= 2, "on a busy machine the second answer may be late, too"
    for job in planned.jobs:
        result_of(job).unlink()
    assert found == [train_block(job, planned.scene.train, device).read_bytes() for job in planned.jobs]


def limit(most: float) -> None:
    """Let clsplat write no file of more bytes in this process. The driver's files stay possible: PoCL may abort."""
    from clsplat import atomic

    class Full:
        def __getattr__(self, name: str) -> Any:
            return getattr(os, name)

        def fsync(self, file: int) -> None:
            if os.fstat(file).st_size > most:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            os.fsync(file)

    atomic.os = Full()  # type: ignore[assignment]


@pytest.mark.slow
@pytest.mark.parametrize("apart", [True, False])
@pytest.mark.parametrize("size", [2000, 5000])  # of a photo; of a result or a checkpoint
def test_a_full_disk_at_a_worker(
    dataset: Path, device: Device, tmp_path: Path, expected: list[bytes], size: int, apart: bool
) -> None:
    """It ends in a sentence. What has been trained is kept, and the others are trained when there is space."""
    planned = plan(dataset, device, tmp_path / "run", 3)
    first = result_of(planned.jobs[0])
    with workers(1, *([APART] if apart else [])) as cluster, distributed.Client(cluster) as client:
        run_on_cluster(cluster.scheduler_address, planned.jobs[:1], planned.scene.train, print)
        written = first.stat().st_mtime_ns
        client.run(limit, size)
        full = r"^block \w+: worker \S+: .*cannot write .*: No space left on device.*; 2 of 2 blocks have failed"
        with pytest.raises(ClsplatError, match=full):
            run(cluster.scheduler_address, planned)
        assert [result_of(job).exists() for job in planned.jobs] == [True, False, False]
        client.run(limit, float("inf"))
        run(cluster.scheduler_address, planned)
    assert [result_of(job).read_bytes() for job in planned.jobs] == expected
    assert first.stat().st_mtime_ns == written


def test_a_full_disk_where_results_arrive(planned: Planned, device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path) -> Any:
        raise InputError(f"cannot write {path}: No space left on device")

    with workers(1, APART) as cluster:
        with monkeypatch.context() as patched:
            patched.setattr("clsplat.blocks.transport.replacing", full)
            with pytest.raises(ClsplatError, match=r"cannot write .*: No space left on device; 2 of 2 blocks"):
                run(cluster.scheduler_address, planned)
        assert not any(result_of(job).exists() for job in planned.jobs)
        run(cluster.scheduler_address, planned)
    assert all(result_of(job).exists() for job in planned.jobs)


@pytest.mark.slow
@pytest.mark.parametrize("apart", [True, False])
def test_a_scheduler_is_started_again(
    dataset: Path, device: Device, tmp_path: Path, expected: list[bytes], apart: bool
) -> None:
    """The run ends in a sentence when the first block is done. The next one trains only the others."""
    planned, port = plan(dataset, device, tmp_path / "run", 3), free_port()
    address, options = f"tcp://127.0.0.1:{port}", ["--preload", APART] if apart else []
    scheduler = started("scheduler", tmp_path, "--host", "127.0.0.1", "--port", str(port))

    def kill() -> None:
        while not any(result_of(job).exists() for job in planned.jobs):
            time.sleep(0.002)
        scheduler.kill()

    with ending(scheduler, worker(address, tmp_path, *options)):
        killer = threading.Thread(target=kill)
        killer.start()
        with pytest.raises(InputError, match=f"^--scheduler: lost the scheduler at {address}; finished blocks are"):
            run(address, planned)
        killer.join()
    kept = {path: path.stat().st_mtime_ns for job in planned.jobs if (path := result_of(job)).exists()}
    assert 0 < len(kept) < 3
    scheduler = started("scheduler", tmp_path, "--host", "127.0.0.1", "--port", str(port))
    with ending(scheduler, worker(address, tmp_path, *options)):
        run(address, planned)
    assert [result_of(job).read_bytes() for job in planned.jobs] == expected
    assert kept == {path: path.stat().st_mtime_ns for path in kept}


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])
