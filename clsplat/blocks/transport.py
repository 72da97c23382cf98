"""Data of blocks through a scheduler of dask, for workers that share no folder with the one who started the run.

A worker asks for what a block needs, in chunks that come with their checksums, and stores it whole in a folder of its
own under names that are digests. Its results go back in the same way. Requests and answers are elements of queues of
the scheduler, so that a worker needs a connection to nothing else.
"""

import asyncio
import io
from collections.abc import Callable
from contextlib import ExitStack, suppress
from itertools import chain
from pathlib import Path
from threading import Thread
from typing import Any, BinaryIO
from uuid import uuid4
from zlib import crc32

import numpy as np

from clsplat.atomic import replacing
from clsplat.blocks.block import log_of, needed_parts, points_of, train_block
from clsplat.blocks.jobs import Job, read_job
from clsplat.blocks.parts import ROWS, Part
from clsplat.camera import Camera
from clsplat.errors import ClsplatError, InputError
from clsplat.formats.validity import reading
from clsplat.scene import DepthMap, View
from clsplat.streaming import PhotoStream, Source, photo_budget
from clsplat.training.preparation import photo_memory

Chunk = bytes | memoryview

CHUNK = 16 << 20
"""Bytes of a request or an answer, at most: it passes through the scheduler's memory."""

PATIENCE = 300
"""Seconds that a worker waits for an answer: the other side may be reading a large photo for another worker."""

ABSENT = -1
"""Size of a layer that a photo does not have."""


class Desk:
    """Answers the requests of workers, on a thread, between entry and exit.

    Parameters
    ----------
    client : distributed.Client
    folder : Path
        That of the jobs, which gets the results.
    views : list of View
        The training photos.

    Attributes
    ----------
    name : str
        Of the queue of requests.
    """

    def __init__(self, client: Any, folder: Path, views: list[View]):
        self.name = f"clsplat-{uuid4().hex}"
        self._client, self._folder = client, folder
        self._views = {view.name: view for view in views}
        self._layer: tuple[tuple[str, str] | None, memoryview] = (None, memoryview(b""))
        self._incoming: dict[tuple[str, str], tuple[ExitStack, BinaryIO]] = {}
        self._answers: dict[str, Any] = {}
        self._thread = Thread(target=self._serve, daemon=True)

    def __enter__(self) -> "Desk":
        from distributed import Queue

        self._requests = Queue(self.name, client=self._client)
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        # Without a scheduler there are no queues to close; the thread ends with the process.
        with suppress(Exception):
            self._requests.put(None)
            self._thread.join()
            for queue in (self._requests, *self._answers.values()):
                queue.close()
        for key in list(self._incoming):
            self._given_up(key)

    def _serve(self) -> None:
        from distributed import Queue

        # Without a scheduler nobody asks; `run_on_cluster` says so.
        with suppress(Exception):
            while request := self._requests.get():
                if request[0] not in self._answers:
                    self._answers[request[0]] = Queue(request[0], client=self._client)
                self._answers[request[0]].put(message(self._answer(*request)))

    def _answer(self, sender: str, what: str, *about: Any) -> Any:
        answers: dict[str, Callable[..., Any]] = {"file": self._file, "photo": self._photo}
        try:
            return self._received(sender, *about) if what == "result" else answers[what](*about)
        except Exception as error:  # any: the worker tells it, and others still need answers
            return str(error) if isinstance(error, ClsplatError) else f"{what}: {error!r}"

    def _file(self, name: str, begin: int, size: int) -> tuple[int, int, Chunk]:
        """Bytes of a file beside the jobs, with its size and their checksum."""
        path = self._folder / Path(name).name
        with reading(path), open(path, "rb") as file:
            file.seek(begin)
            data = file.read(min(size, CHUNK))
        return path.stat().st_size, crc32(data), data

    def _photo(self, name: str, layer: str, begin: int, size: int) -> tuple[int, int, Chunk]:
        """Bytes of an array of a photo as .npy. The last array stays in memory: its next chunk follows."""
        if self._layer[0] != (name, layer):
            view = self._views[name].loaded()
            array = view.depth.values if layer == "depth" and view.depth else getattr(view, layer)
            stored = io.BytesIO()
            if array is not None:
                np.lib.format.write_array(stored, array, allow_pickle=False)
            self._layer = (name, layer), stored.getbuffer()
        data = self._layer[1][begin : begin + min(size, CHUNK)]
        return len(self._layer[1]) or ABSENT, crc32(data), data

    def _received(self, sender: str, name: str, begin: int, total: int, expected: int, data: Chunk) -> bool:
        """Append bytes of a result to its file, which appears when it is whole."""
        key = sender, Path(name).name
        check(name, data, expected)
        if begin == 0:
            self._given_up(key)
            begun = ExitStack()
            self._incoming[key] = begun, begun.enter_context(replacing(self._folder / key[1]))
        opened, file = self._incoming.pop(key)
        with opened:
            file.write(data)
            if file.tell() < total:
                self._incoming[key] = opened.pop_all(), file
        return True

    def _given_up(self, key: tuple[str, str]) -> None:
        """Remove what has arrived of a result whose sender began again, or is gone."""
        if key in self._incoming:
            with suppress(InputError), self._incoming.pop(key)[0]:
                raise InputError(f"{key[1]}: incomplete")


class Cache:
    """Files of a worker, from a `Desk`. Those that are there are not asked for again.

    Parameters
    ----------
    folder : Path
    desk : str
        Name of its queue.
    """

    def __init__(self, folder: Path, desk: str):
        from distributed import Queue

        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._requests, self._answers = folder, Queue(desk), Queue(f"{desk}-{uuid4().hex}")

    def close(self) -> None:
        """Remove the queue of answers from the scheduler."""
        self._answers.close()

    def _ask(self, *request: Any) -> Any:
        try:
            self._requests.put(message((self._answers.name, *request)), timeout=PATIENCE)
            answer = self._answers.get(timeout=PATIENCE)
        except (OSError, asyncio.TimeoutError) as error:
            raise InputError(
                f"expected an answer from the command that trains the blocks within {PATIENCE} seconds, found "
                f"{error!r}"
            ) from error
        if isinstance(answer, str):
            raise InputError(answer)
        return answer

    def _fetched(self, path: Path, *what: str, begin: int = 0, size: int | None = None) -> bool:
        """Store `size` bytes, or all, of what is asked for; return whether it exists."""
        if path.exists():
            return True
        done = 0
        total, expected, data = self._ask(*what, begin, CHUNK if size is None else size)
        if total == ABSENT:
            return False
        size = total if size is None else size
        with replacing(path) as file:
            while True:
                check(path.name, data, expected)
                file.write(data)
                done += len(data)
                if done == size:
                    return True
                _, expected, data = self._ask(*what, begin + done, size - done)

    def file(self, name: str) -> Path:
        """A file beside the jobs."""
        self._fetched(self._folder / name, "file", name)
        return self._folder / name

    def rows(self, part: Part) -> None:
        """The rows of a part of a scene, where `clsplat.blocks.parts.read_part` finds them."""
        self._fetched(self._folder / f"{part.digest}{ROWS}", "file", part.file, begin=part.begin, size=part.size)

    def photos(self, job: Job) -> list[View]:
        """The photos of a block, in memory or, if they do not fit it, read when they are needed."""
        sources = {
            name: self._source(name, job, camera) for name, camera in zip(job.photos, job.posed(), strict=True)
        }
        budget = photo_budget(photo_memory(job.config))
        if budget is None or sum(source.nbytes for source in sources.values()) <= budget:
            views = [source.decode() for source in sources.values()]
        else:
            views = PhotoStream(sources, budget).views()
        return [view.with_depth(self._depth(view.name, job)) for view in views]

    def _source(self, name: str, job: Job, camera: Camera) -> Source:
        photo = job.photos[name]
        files = {"image": photo.pixels, "clear": photo.pixels} | ({"mask": photo.mask} if photo.mask else {})
        paths = {layer: self._folder / f"{digest}.{layer}.npy" for layer, digest in files.items()}
        paths = {layer: path for layer, path in paths.items() if self._fetched(path, "photo", name, layer)}

        def decode() -> View:
            return View(name, camera, **{layer: read_array(path) for layer, path in paths.items()})

        def used() -> bool:
            return "mask" not in paths or bool(read_array(paths["mask"]).any())

        return Source(decode, camera, tuple(paths), used)

    def _depth(self, name: str, job: Job) -> DepthMap | None:
        if name not in job.depths:
            return None
        path = self._folder / f"{job.depths[name]['values']}.depth.npy"
        self._fetched(path, "photo", name, "depth")
        return DepthMap(read_array(path))

    def send(self, path: Path) -> None:
        """Send a result."""
        total = path.stat().st_size
        with reading(path), open(path, "rb") as file:
            while data := file.read(CHUNK):
                self._ask("result", path.name, file.tell() - len(data), total, crc32(data), data)


def message(parts: Any) -> Any:
    """A request or an answer for a queue, whose chunk goes beside it: neither msgpack nor the scheduler copies it."""
    from distributed.protocol import Serialize

    if not isinstance(parts, tuple):
        return parts
    return tuple(Serialize(memoryview(part)) if isinstance(part, bytes | memoryview) else part for part in parts)


def check(name: str, data: Chunk, expected: int) -> None:
    """Raise an InputError if a chunk is empty or has another checksum than the one that came with it."""
    if not data or crc32(data) != expected:
        raise InputError(f"{name}: expected bytes with the checksum {expected}, found others")


def read_array(path: Path) -> Any:
    """Read a .npy file, or raise an InputError."""
    try:
        return np.load(path)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"cannot read {path}: {error}") from error


def train_from(desk: str, name: str, folder: Path) -> None:
    """Train a block on a worker with what a `Desk` gives, and send the result.

    Parameters
    ----------
    desk : str
        Name of its queue.
    name : str
        Name of the job's file.
    folder : Path
        The worker's own. What it holds of other blocks is used again.

    Raises
    ------
    InputError
        If something cannot be had, or is not what the job was made with.
    ClsplatError
        Those of `train_block`.
    """
    with ExitStack() as stack:
        cache = Cache(folder, desk)
        stack.callback(cache.close)
        job_file = cache.file(name)
        job = read_job(job_file)
        for named in {job.scene, job.far, job.sky, job.points, job.moving} - {""}:
            cache.file(named)
        for part in chain((part for _, part, _ in needed_parts(job_file, job)), points_of(job_file, job)):
            cache.rows(part)
        result = train_block(job_file, cache.photos(job))
        cache.send(log_of(job_file))
        cache.send(result)  # last: a block with a result is done
        for file in (log_of(job_file), result):
            file.unlink()
