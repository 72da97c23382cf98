"""Overhead of dask.distributed per task, as `run_on_cluster` submits blocks, and the rate of data for workers.

Usage: python tests/blocks/measure_dask.py [TASKS [MB]]

Submits tasks that do nothing (default: 2000) to a `LocalCluster` of two workers, and prints the processor time of
this process, in which the scheduler runs, and the wall time, per task. Then sends a file (default: 256 MB) to a
worker without a shared folder, and back, and prints the same per GB.
"""

import os
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from distributed import Client, LocalCluster, as_completed, get_worker

from clsplat.blocks.cluster import CACHE, RESOURCE, RETRIES
from clsplat.blocks.transport import Cache, Desk


def nothing(job: str) -> str:
    return job


def there_and_back(desk: str) -> None:
    """Get a file on a worker, and send it back."""
    cache = Cache(Path(get_worker().local_directory) / CACHE, desk)
    cache.send(cache.file("data"))


def main() -> None:
    count, size = (int(word) for word in (*sys.argv[1:], *("2000", "256")[len(sys.argv) - 1 :]))
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, resources={RESOURCE: 1}, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        client.submit(nothing, "first", resources={RESOURCE: 1}).result()
        started = time.process_time(), time.perf_counter()
        tasks = [
            client.submit(nothing, f"{k}.json", key=f"clsplat-{k}", resources={RESOURCE: 1}, retries=RETRIES)
            for k in range(count)
        ]
        for task in as_completed(tasks):
            task.result()
        used, wall = time.process_time() - started[0], time.perf_counter() - started[1]
        print(f"{count} tasks: {1e3 * used / count:.2f} ms of processor time and {1e3 * wall / count:.2f} ms each")
        with TemporaryDirectory() as folder, Desk(client, Path(folder), []) as desk:
            (Path(folder) / "data").write_bytes(os.urandom(size * 1_000_000))
            started = time.process_time(), time.perf_counter()
            client.submit(there_and_back, desk.name, resources={RESOURCE: 1}).result()
            used, wall = time.process_time() - started[0], time.perf_counter() - started[1]
        moved = 2 * size / 1e3
        print(
            f"{moved} GB to and from a worker: {used / moved:.2f} s of processor time and {wall / moved:.2f} s per GB"
        )


if __name__ == "__main__":
    main()
