"""Blocks on dask.distributed: 1, 2 and 3 workers give the bytes of this process, and dead workers cost nothing."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from small_plan import Planned, plan

from clsplat.blocks.block import result_of, train_block
from clsplat.blocks.cluster import run_on_cluster
from clsplat.device import Device
from clsplat.errors import InputError

distributed = pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
import dask  # noqa: E402  (comes with it)

# dask's processes outlive their sockets and event loops by a moment when they end.
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")


@contextmanager
def workers(count: int, **options: Any) -> Iterator[Any]:
    """A cluster of this machine with processes that declare a device each."""
    settings = {"threads_per_worker": 1, "dashboard_address": None, "resources": {"CL": 1}} | options
    with distributed.LocalCluster(n_workers=count, processes=True, **settings) as cluster:
        yield cluster


@pytest.fixture
def expected(dataset: Path, device: Device, tmp_path: Path) -> list[bytes]:
    alone = plan(dataset, device, tmp_path / "alone", 3)
    return [train_block(job, alone.scene.train, device).read_bytes() for job in alone.jobs]


def test_two_workers_give_the_bytes_of_this_process(
    dataset: Path, device: Device, tmp_path: Path, expected: list[bytes]
) -> None:
    jobs, told = plan(dataset, device, tmp_path / "cluster", 3).jobs, []
    with workers(2) as cluster:
        run_on_cluster(cluster.scheduler_address, jobs, [], told.append)
    assert [result_of(job).read_bytes() for job in jobs] == expected
    assert [text.split(",")[0] for text in told] == [f"blocks: {n} of 3 done" for n in (1, 2, 3)]


def test_there_is_no_scheduler(planned: Planned) -> None:
    with dask.config.set({"distributed.comm.timeouts.connect": "100ms"}):
        with pytest.raises(
            InputError, match=r"^--scheduler: expected a scheduler of dask at tcp://127.0.0.1:9, found"
        ):
            run_on_cluster("tcp://127.0.0.1:9", planned.jobs, [], print)


def test_the_extra_is_missing(planned: Planned, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    with pytest.raises(InputError, match=r"pip install 'clsplat\[cluster\]'"):
        run_on_cluster("tcp://127.0.0.1:9", planned.jobs, [], print)


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 3])
def test_any_number_of_workers(
    dataset: Path, device: Device, tmp_path: Path, expected: list[bytes], count: int
) -> None:
    jobs = plan(dataset, device, tmp_path / "cluster", 3).jobs
    with workers(count) as cluster:
        run_on_cluster(cluster.scheduler_address, jobs, [], lambda text: None)
    assert [result_of(job).read_bytes() for job in jobs] == expected


@pytest.mark.slow
def test_a_worker_is_killed(dataset: Path, device: Device, tmp_path: Path, expected: list[bytes]) -> None:
    """Whenever a block has a checkpoint, kill its worker, once per block."""
    import os
    import signal
    import threading
    import time

    jobs = plan(dataset, device, tmp_path / "cluster", 3).jobs
    killed: set[str] = set()
    ends = threading.Event()

    def hunt(cluster: Any) -> None:
        while not ends.wait(0.01):
            for job in jobs:
                if job.stem in killed or not (job.with_suffix("") / "checkpoint.npz").exists():
                    continue
                killed.add(job.stem)
                pids = [w["pid"] for w in client.run(lambda: {"pid": os.getpid()}).values()]
                os.kill(pids[0], signal.SIGKILL)
                time.sleep(0.5)

    with workers(2) as cluster, distributed.Client(cluster) as client:
        hunter = threading.Thread(target=hunt, args=[cluster])
        hunter.start()
        try:
            run_on_cluster(cluster.scheduler_address, jobs, [], lambda text: None)
        finally:
            ends.set()
            hunter.join()
    assert killed
    assert [result_of(job).read_bytes() for job in jobs] == expected
