"""Overhead of dask.distributed per task, as `run_on_cluster` submits blocks.

Usage: python tests/blocks/measure_dask.py [TASKS]

Submits tasks that do nothing (default: 2000) to a `LocalCluster` of two workers, and prints the processor time of
this process, in which the scheduler runs, and the wall time, per task.
"""

import sys
import time

from distributed import Client, LocalCluster, as_completed

from clsplat.blocks.cluster import RESOURCE, RETRIES


def nothing(job: str) -> str:
    return job


def main() -> None:
    count = int(sys.argv[1]) if sys.argv[1:] else 2000
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


if __name__ == "__main__":
    main()
