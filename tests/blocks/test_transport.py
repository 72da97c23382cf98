"""Blocks of workers without a shared folder: the same bytes, in checked chunks, and errors in a sentence."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue
from typing import Any, ClassVar
from zlib import crc32

import numpy as np
import pytest
from small_plan import CONFIG, Planned, plan

from clsplat.blocks import cluster, transport
from clsplat.blocks.block import log_of, result_of, train_block
from clsplat.blocks.cluster import run_on_cluster
from clsplat.blocks.jobs import make_job, read_job
from clsplat.blocks.masks import write_masks
from clsplat.blocks.parts import write_index
from clsplat.blocks.transport import Cache, Desk
from clsplat.dataset.brightness import evened
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.formats import save_gaussians
from clsplat.inputs import photos_of
from clsplat.scene import DepthMap
from clsplat.testing import synthetic_scene

distributed = pytest.importorskip("distributed", reason="the extra `cluster` is not installed")

# dask's processes outlive their sockets and event loops by a moment when they end.
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")

SMALL = 3000
"""Bytes of a chunk: a photo has 3968, with its header, and a part of a scene more."""


def apart() -> None:
    """Let a worker share no folder, and take small chunks."""
    cluster._is_here = lambda job: False
    transport.CHUNK = SMALL


def held(dask_worker: Any) -> list[str]:
    """Names of the files that a worker has of its own."""
    return sorted(path.name for path in (Path(dask_worker.local_directory) / cluster.CACHE).iterdir())


@contextmanager
def two_workers(**options: Any) -> Iterator[Any]:
    settings = {"threads_per_worker": 1, "dashboard_address": None, "resources": {"CL": 1}} | options
    with distributed.LocalCluster(n_workers=2, processes=True, **settings) as started:
        yield started


def under_a_sky(planned: Planned) -> Planned:
    """The same blocks before Gaussians that none of them trains, with masks of what moves."""
    folder, sky = planned.jobs[0].parent, synthetic_scene(50, seed=3)[0]
    save_gaussians(folder / "sky.ply", replace(sky, means=sky.means + np.float32([0, 0, 9])))
    index = write_index([folder / "sky.ply"]).name
    moving = write_masks({view.name: np.arange(80).reshape(8, 10) < 30 for view in planned.scene.train}, folder)
    jobs = [replace(read_job(job), sky=index, moving=moving).write(folder) for job in planned.jobs]
    return replace(planned, jobs=jobs)


def test_workers_without_a_shared_folder_give_the_same_bytes(
    dataset: Path, device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = under_a_sky(plan(dataset, device, tmp_path / "alone", 3))
    results = [train_block(job, expected.scene.train, device).read_bytes() for job in expected.jobs]
    planned = under_a_sky(plan(dataset, device, tmp_path / "run", 3))
    monkeypatch.setattr(transport, "CHUNK", SMALL)
    sizes: list[int] = []
    monkeypatch.setattr(transport, "crc32", lambda data: sizes.append(len(data)) or crc32(data))
    with two_workers() as started, distributed.Client(started) as client:
        client.run(apart)
        run_on_cluster(started.scheduler_address, planned.jobs, planned.scene.train, lambda text: None)
        folders = client.run(held)
    assert [result_of(job).read_bytes() for job in planned.jobs] == results
    assert all(log_of(job).exists() for job in planned.jobs)
    assert max(sizes) == SMALL
    names = {name for names in folders.values() for name in names}
    assert {Path(name).suffix for name in names} == {".json", ".parts", ".rows", ".npy", ".npz"}
    assert not list(planned.jobs[0].parent.glob(".*"))


APART = """
from clsplat.blocks import cluster
cluster._is_here = lambda job: False
"""
"""Makes each worker share no folder, also one that dask starts again."""


@pytest.mark.slow
@pytest.mark.parametrize("reached", ["*.npy", "*/checkpoint.npz", "*.ply"])
def test_a_worker_without_a_shared_folder_is_killed(
    dataset: Path, device: Device, tmp_path: Path, reached: str
) -> None:
    """Kill a worker that gets photos, trains, or has a result that it has not sent, once."""
    expected = plan(dataset, device, tmp_path / "alone", 3)
    results = [train_block(job, expected.scene.train, device).read_bytes() for job in expected.jobs]
    planned, ends, killed = plan(dataset, device, tmp_path / "run", 3), threading.Event(), []

    def hunt() -> None:
        while not ends.wait(0.002) and not killed:
            for pid, folder in list(workers.values()):
                if any(Path(folder).glob(f"{cluster.CACHE}/{reached}")):
                    os.kill(pid, signal.SIGKILL)
                    killed.append(pid)
                    break

    with two_workers(preload=[APART]) as started, distributed.Client(started) as client:
        workers = client.run(lambda dask_worker: (os.getpid(), dask_worker.local_directory))
        hunter = threading.Thread(target=hunt)
        hunter.start()
        try:
            run_on_cluster(started.scheduler_address, planned.jobs, planned.scene.train, lambda text: None)
        finally:
            ends.set()
            hunter.join()
    assert killed and [result_of(job).read_bytes() for job in planned.jobs] == results


class Near:
    """A queue within this process, as `distributed.Queue`."""

    all: ClassVar[dict[str, SimpleQueue[Any]]] = {}

    def __init__(self, name: str, client: Any = None):
        self.name, self._queue = name, self.all.setdefault(name, SimpleQueue())

    def put(self, value: Any, timeout: float | None = None) -> None:
        def unpacked(part: Any) -> Any:
            return part.data if isinstance(part, distributed.protocol.Serialize) else part

        self._queue.put(tuple(map(unpacked, value)) if isinstance(value, tuple) else value)

    def get(self, timeout: float | None = None) -> Any:
        return self._queue.get(timeout=20 if timeout is None else timeout)

    def close(self) -> None:
        del self.all[self.name]


@pytest.fixture
def near(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(distributed, "Queue", Near)
    monkeypatch.setattr(transport, "CHUNK", SMALL)


@pytest.mark.parametrize("memory", [None, "0.01MB"])
def test_photos_arrive_with_all_their_layers(
    planned: Planned, tmp_path: Path, near: None, memory: str | None
) -> None:
    shape, rng = (32, 40), np.random.default_rng(0)
    views = [
        replace(
            view,
            mask=rng.random(shape) < 0.5 if k % 2 else None,
            clear=rng.integers(0, 256, shape, np.uint8) if k % 3 else None,
            depth=DepthMap(rng.random(shape, np.float32), scale=2.0) if k % 4 else None,
        )
        for k, view in enumerate(planned.scene.train)
    ]
    config = replace(CONFIG, memory_limit=memory)
    block = planned.plan.blocks[0]._replace(photos=np.arange(len(views)))
    scene = replace(planned.scene, train=views, gains={views[1].name: np.array([2.0, 1.0, 1.0])})
    job = make_job(
        tmp_path, {"far": "scene", "sky": "", "moving": ""}, block, scene, photos_of(views, np.zeros(3)), config
    )
    assert read_job(job.write(tmp_path)).gains == job.gains == {views[1].name: [2.0, 1.0, 1.0]}
    with Desk(None, tmp_path, views) as desk:
        found = Cache(tmp_path / "cache", desk.name).photos(job)
    assert all((view.ahead > 0) == (memory is not None) for view in found)
    for view, expected in zip(job.views(found), evened(scene).train, strict=True):
        view = view.loaded()
        for layer in ("image", "mask", "clear"):
            np.testing.assert_array_equal(getattr(view, layer), getattr(expected, layer))
        assert view.camera.fx == expected.camera.fx and (view.depth is None) == (expected.depth is None)
        if view.depth and expected.depth:
            np.testing.assert_array_equal(view.depth.disparities, expected.depth.disparities)


def test_other_bytes_are_not_stored(planned: Planned, tmp_path: Path, near: None, monkeypatch: Any) -> None:
    """The second chunk of a file has lost a bit."""
    read = Desk._file

    def damaged(self: Desk, name: str, begin: int, size: int) -> tuple[int, int, bytes]:
        total, found, data = read(self, name, begin, size)
        return total, found, data if begin == 0 else bytes([data[0] ^ 1]) + data[1:]

    monkeypatch.setattr(Desk, "_file", damaged)
    job = planned.jobs[0]
    assert job.stat().st_size > SMALL
    with Desk(None, job.parent, []) as desk:
        cache = Cache(tmp_path / "cache", desk.name)
        with pytest.raises(InputError, match=f"{job.name}: expected bytes with the checksum .*, found others"):
            cache.file(job.name)
        with pytest.raises(InputError, match=r"cannot read .*nothing: No such file"):
            cache.file("nothing")
        with pytest.raises(InputError, match=r"photo: KeyError\('9\.png'\)"):
            cache._ask("photo", "9.png", "image", 0, SMALL)
    assert not list((tmp_path / "cache").iterdir())


def test_a_result_appears_when_it_is_whole(tmp_path: Path, near: None) -> None:
    result = tmp_path / "worker" / "one.ply"
    result.parent.mkdir()
    (tmp_path / "jobs").mkdir()
    result.write_bytes(np.random.default_rng(0).bytes(2 * SMALL + 1))
    with Desk(None, tmp_path / "jobs", []) as desk:
        for sent in (1, 2):  # workers that die after a chunk or two
            dies = Cache(tmp_path / "worker", desk.name)
            for begin in range(0, sent * SMALL, SMALL):
                data = result.read_bytes()[begin : begin + SMALL]
                dies._ask("result", "one.ply", begin, 2 * SMALL + 1, crc32(data), data)
            assert not (tmp_path / "jobs" / "one.ply").exists()
        with pytest.raises(InputError, match=r"one\.ply: expected bytes with the checksum"):
            dies._ask("result", "one.ply", 0, 3, crc32(b"abc"), b"abd")
        Cache(tmp_path / "worker", desk.name).send(result)
        assert (tmp_path / "jobs" / "one.ply").read_bytes() == result.read_bytes()
    assert [path.name for path in (tmp_path / "jobs").iterdir()] == ["one.ply"], "what is incomplete is removed"
