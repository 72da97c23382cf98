"""Photos that do not fit the memory: they are decoded when they are needed, the next ones ahead of time."""

import os
import warnings
from collections import OrderedDict
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from hashlib import blake2b
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from threading import Lock
from typing import Any
from weakref import finalize

import numpy as np
from filelock import FileLock, Timeout
from numpy.typing import NDArray

from clsplat.atomic import replacing
from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.host_memory import physical_memory
from clsplat.scene import DepthMap, View

MOST_AHEAD = 8
"""Most photos that are decoded ahead. With more, a step waits no less: decoding then takes longer than training."""

PHOTO_SHARE = 0.5
"""Fraction of the machine's memory that decoded photos may take by default. The rest is for the system, for the
training, and on a CPU for the memory of the device."""

LAYERS = ("image", "mask", "clear")
"""Arrays of a view."""

NO_COPIES = "photos are decoded each time that they are used"
"""What a warning says where no copies can be written."""

LOCK = ".lock"
"""Name of the file, in a folder of copies, that is locked while their process lives."""


def photo_budget(memory: int | None) -> int | None:
    """Bytes that decoded photos may take: `memory`, or without it a share of the machine's, where that is known."""
    available = physical_memory()
    return memory if memory is not None or available is None else round(PHOTO_SHARE * available)


@dataclass(frozen=True)
class Source:
    """Source of a photo that is read when it is needed.

    decode: returns it, with the arrays of `View`; camera: its camera; layers: arrays that it may have; used: whether
    any pixel counts, found without decoding the photo itself.
    """

    decode: Callable[[], View]
    camera: Camera
    layers: tuple[str, ...] = LAYERS
    used: Callable[[], bool] = lambda: True

    @property
    def nbytes(self) -> int:
        """Bytes of its arrays, at most."""
        return self.camera.width * self.camera.height * (3 + len(self.layers) - 1)


class PhotoStream:
    """Photos of which at most a number of bytes is in memory: those used last, and the next ones.

    A photo must be the same whenever it is read: its digests are compared with the first ones.

    Parameters
    ----------
    sources : dict of Source
        By the photos' names.
    budget : int
        Bytes of photos in memory. One photo is kept in any case.
    copies : Files, optional
        Where decoded photos are written and read again: where decoding takes longer than reading them.
    """

    def __init__(self, sources: Mapping[str, Source], budget: int, copies: "Files | None" = None):
        self._sources, self._copies = sources, copies
        largest = max(source.nbytes for source in sources.values())
        # Half of the photos that fit may be those to come, of which each is decoded by a thread.
        self.ahead = max(1, min(os.cpu_count() or 1, MOST_AHEAD, budget // largest // 2))
        self._budget = budget - self.ahead * largest
        self._pool = ThreadPoolExecutor(self.ahead, "photos")
        self._lock = Lock()
        self._kept: OrderedDict[str, View] = OrderedDict()
        self._coming: dict[str, Future[View]] = {}
        self._digests: dict[str, tuple[str, str]] = {}
        self._used: dict[str, bool] = {}

    def views(self) -> list[View]:
        """The photos, in the order of `sources`."""
        return [StreamedView.of(name, s.camera, self) for name, s in self._sources.items()]

    def layers(self, name: str) -> tuple[str, ...]:
        """Arrays that a photo may have."""
        return self._sources[name].layers

    def used(self, name: str) -> bool:
        """Whether any pixel of a photo counts."""
        if name not in self._used:
            self._used[name] = self._sources[name].used()
        return self._used[name]

    def digests(self, name: str) -> tuple[str, str] | None:
        """Digests of a photo's pixels and mask, if it has been read or they are expected."""
        return self._digests.get(name)

    def expect(self, name: str, digests: tuple[str, str]) -> None:
        """Demand that a photo, once it is read, has these digests."""
        self._digests.setdefault(name, digests)

    def prefetch(self, name: str) -> None:
        """Begin to read a photo that is needed soon, unless too many are being read."""
        with self._lock:
            if name not in self._kept and name not in self._coming and len(self._coming) < self.ahead:
                self._coming[name] = self._pool.submit(self._fetch, name)

    def __call__(self, name: str) -> View:
        """Return a photo with its arrays, and with the camera of its source.

        Raises
        ------
        InputError
            If it cannot be read, or differs from what was read before.
        """
        with self._lock:
            if name in self._kept:
                self._kept.move_to_end(name)
                return self._kept[name]
            coming = self._coming.get(name)
        return self._fetch(name) if coming is None else coming.result()

    def _fetch(self, name: str) -> View:
        try:
            view = self._read(name)
            with self._lock:
                self._kept[name] = view
                size = sum(map(_nbytes, self._kept.values()))
                while len(self._kept) > 1 and size > self._budget:
                    size -= _nbytes(self._kept.popitem(last=False)[1])
            return view
        finally:
            with self._lock:
                self._coming.pop(name, None)

    def _read(self, name: str) -> View:
        source, known = self._sources[name], self._digests.get(name)
        copies = self._copies  # bound once: another thread may give them up
        if copies is not None and known is not None:
            copy = copies.read(name, source.camera)
            if copy is not None and copy.digests == known:
                return copy
        view = source.decode()
        found = view.digests
        assert found
        if self._digests.setdefault(name, found) != found:
            raise InputError(
                f"photo {name}: expected the pixels and mask that the run has read before, found others; put it back"
            )
        try:
            if copies is not None:
                copies.write(view)
        except InputError as error:
            warnings.warn(f"{error}; {NO_COPIES}", stacklevel=2)
            self._copies = None
        return view


def _nbytes(view: View) -> int:
    return sum(array.nbytes for array in (view.image, view.mask, view.clear) if array is not None)


class StreamedView(View):
    """A view that a `PhotoStream` reads when its arrays are needed.

    ``dataclasses.replace`` makes an ordinary view of it, in memory; `with_camera` and `changed` do not.
    """

    _stream: PhotoStream
    _load: Callable[[], View] | None  # for a view that has been changed
    _depth: DepthMap | None  # in memory, before changes
    _masked: bool  # by a change

    def __new__(cls, *args: Any, **kwargs: Any) -> Any:
        return View(*args, **kwargs)

    @classmethod
    def of(
        cls,
        name: str,
        camera: Camera,
        stream: PhotoStream,
        load: Callable[[], View] | None = None,
        depth: DepthMap | None = None,
        masked: bool = False,
    ) -> "StreamedView":
        """A view of a stream's photo. `load` returns it with its depth map, if it is not as the stream has it."""
        view: StreamedView = object.__new__(cls)
        view.__dict__.update(name=name, camera=camera, _stream=stream, _load=load, _depth=depth, _masked=masked)
        return view

    def loaded(self) -> View:
        if self._load:
            return replace(self._load(), camera=self.camera)
        return replace(self._stream(self.name), camera=self.camera, depth=self._depth)

    def _layer(self, name: str) -> Any:
        known = name in self._stream.layers(self.name) or (name == "mask" and self._masked)
        return getattr(self.loaded(), name) if known else None

    @property
    def image(self) -> NDArray[np.uint8]:
        return self.loaded().image

    @property
    def mask(self) -> NDArray[np.bool_] | None:
        return self._layer("mask")

    @property
    def clear(self) -> NDArray[np.uint8] | None:
        return self._layer("clear")

    @property
    def depth(self) -> DepthMap | None:
        return self.loaded().depth if self._load and self._depth else self._depth

    def prefetch(self) -> None:
        self._stream.prefetch(self.name)

    def with_camera(self, camera: Camera) -> View:
        return self.of(self.name, camera, self._stream, self._load, self._depth, self._masked)

    def with_depth(self, depth: DepthMap | None) -> View:
        load = (lambda: replace(self.loaded(), depth=depth)) if self._load else None
        return self.of(self.name, self.camera, self._stream, load, depth, self._masked)

    def changed(self, change: Callable[[View], View], camera: Camera | None = None, *, masks: bool = False) -> View:
        camera, masked = camera or self.camera, self._masked or masks
        return self.of(self.name, camera, self._stream, lambda: change(self.loaded()), self._depth, masked)

    @property
    def ahead(self) -> int:
        return self._stream.ahead

    @property
    def is_used(self) -> bool:
        return self._stream.used(self.name)

    @property
    def digests(self) -> tuple[str, str] | None:
        """Those of the photo before changes, as `expect` has them, too."""
        return self._stream.digests(self.name)

    def expect(self, digests: tuple[str, str]) -> None:
        self._stream.expect(self.name, digests)


class Files:
    """Decoded photos as .npy files in a folder."""

    def __init__(self, folder: Path):
        self._folder = folder

    @classmethod
    def temporary(cls) -> "Files | None":
        """Files in the user's cache that are removed when they are no longer used, and those of dead processes.

        None, with a warning, where none can be written there.
        """
        try:
            root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "clsplat"
            root.mkdir(parents=True, exist_ok=True)
            for left in root.glob("photos-*"):
                with suppress(Timeout, OSError), FileLock(left / LOCK, blocking=False):
                    rmtree(left, ignore_errors=True)
            folder = Path(mkdtemp(prefix="photos-", dir=root))
            lock = FileLock(folder / LOCK)
            lock.acquire()
        # Without a home, or on a file system without locks, it is a RuntimeError.
        except (OSError, RuntimeError) as error:
            warnings.warn(f"cannot write copies of photos to the cache: {error}; {NO_COPIES}", stacklevel=2)
            return None
        result = cls(folder)
        finalize(result, _removed, folder, lock)
        return result

    def _file(self, name: str, layer: str) -> Path:
        return self._folder / f"{blake2b(name.encode(), digest_size=16).hexdigest()}.{layer}.npy"

    def write(self, view: View) -> None:
        """Write a photo; an InputError if that fails."""
        for layer in LAYERS:
            if (found := getattr(view, layer)) is not None:
                array = np.ascontiguousarray(found)
                header = np.lib.format.header_data_from_array_1_0(array)
                with replacing(self._file(view.name, layer)) as file:
                    # Not np.save: on a full disk it may leave a part of a small array without an error.
                    np.lib.format.write_array_header_1_0(file, header)
                    file.write(array.data)

    def views(self, like: list[View], budget: int) -> list[View]:
        """The photos that have been written, as a stream; `like`: views of the same names and cameras."""

        def source(view: View) -> Source:
            def decode() -> View:
                if (found := self.read(view.name, view.camera)) is None:
                    raise InputError(f"cannot read {self._file(view.name, 'image')}: it is missing or damaged")
                return found

            layers = tuple(layer for layer in LAYERS if self._file(view.name, layer).exists())
            return Source(decode, view.camera, layers, lambda: view.is_used)

        return PhotoStream({view.name: source(view) for view in like}, budget).views()

    def read(self, name: str, camera: Camera) -> View | None:
        """Read a photo again; None where there is no copy that can be read."""
        arrays = {}
        try:
            for layer in LAYERS:
                if layer == "image" or self._file(name, layer).exists():
                    arrays[layer] = np.load(self._file(name, layer))
        except (OSError, ValueError, EOFError):
            return None
        return View(name, camera, **arrays)


def _removed(folder: Path, lock: FileLock) -> None:
    lock.release()
    rmtree(folder, ignore_errors=True)
