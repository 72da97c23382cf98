"""What a run leaves in its folder so that it can go on: the checkpoint and the log."""

import io
import json
import math
import zipfile
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, nullcontext
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.atomic import replacing
from clsplat.config import TrainConfig
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.render import download, fetch, stage_functions, upload
from clsplat.scene import Scene, View
from clsplat.training import photo_exposures as exposure
from clsplat.training import photo_poses as poses
from clsplat.training.autosize.rule import Kept, Point, Rival, Search, Trial
from clsplat.training.densify import STRATEGIES, Strategy
from clsplat.training.optimizer import Moments
from clsplat.training.photo_parameters import PerPhoto

if TYPE_CHECKING:
    from clsplat.device import Device


@dataclass
class State:
    """All that training changes, which is what a checkpoint holds, and the scene's extent in world units.

    intersections: the most tiles that a Gaussian has met in a view, on the mean over all Gaussians; it bounds their
    growth where memory does. search: for the scene's size; None where that is fixed. exposures, poses: what is
    learned about each photo, if it is. pixels: their sizes, of the 3D filter; None without it, or to be found anew.
    """

    iteration: int
    seconds: float
    extent: float
    gaussians: Gaussians
    moments: Moments
    strategy: Strategy
    intersections: float = 0.0
    search: Search | None = None
    exposures: PerPhoto | None = None
    poses: PerPhoto | None = None
    pixels: Any = None


def move(state: State, device: "Device | None") -> None:
    """Parameters, moments and statistics to the device, or to the host for None."""
    place = partial(upload, device) if device else fetch
    state.gaussians = place(state.gaussians)
    state.moments = Moments(place(state.moments.first), place(state.moments.second))
    statistics = state.strategy.statistics
    for name, array in statistics.items():
        statistics[name] = device.upload(name, array, array.dtype) if device else download(array)


def as_seen(views: list[View], state: State) -> list[View]:
    """Photos as the scene itself would show them: without what was learned about each."""
    if state.exposures:
        views = [replace(v, image=exposure.neutral(v.image, state.exposures.of(v.name))) for v in views]
    if state.poses:
        views = [replace(v, camera=poses.refined(v.camera, state.poses.of(v.name))) for v in views]
    return views


def on_device(gaussians: Gaussians, device: "Device") -> Gaussians:
    """The Gaussians on the device, where they are with its optimiser."""
    return upload(device, gaussians) if isinstance(gaussians.means, np.ndarray) else gaussians


def measure_pixels(state: State, views: list[View], device: "Device") -> None:
    """What the photos' cameras resolve at each Gaussian. Changes `state`."""
    cameras = [view.camera for view in views]
    state.pixels = stage_functions(device).pixel_sizes(on_device(state.gaussians, device), cameras)


def filtered(state: State, device: "Device") -> Gaussians:
    """The Gaussians on the device as they are shown and saved: under the 3D filter, if there is one."""
    gaussians = on_device(state.gaussians, device)
    if state.pixels is None:
        return gaussians
    shown: Gaussians = stage_functions(device).filter_fwd(gaussians, state.pixels)
    return shown


def save_state(path: Path, state: State, config: TrainConfig) -> None:
    """Write the state to an .npz file, whole or not at all."""
    arrays: dict[str, Any] = {"iteration": state.iteration, "seconds": state.seconds}
    arrays["intersections"] = state.intersections
    arrays["config"] = json.dumps(asdict(config), sort_keys=True)
    parts = {"gaussians": state.gaussians, "first": state.moments.first, "second": state.moments.second}
    for part, gaussians in parts.items():
        arrays |= {f"{part}.{name}": array for name, array in fetch(gaussians).arrays().items()}
    arrays |= {f"statistics.{name}": download(array) for name, array in state.strategy.statistics.items()}
    if state.pixels is not None:
        arrays["pixels"] = download(state.pixels)
    for part, learned in (("exposures", state.exposures), ("poses", state.poses)):
        if learned:
            arrays |= {f"{part}.{name}": array for name, array in learned.arrays().items()}
    if search := state.search:
        about = {name: getattr(search, name) for name in ("most", "trials", "degrees", "settled", "seen")}
        if search.rival:
            about["rival"] = search.rival.point
            rival = search.rival.kept
            parts = {"": rival.gaussians, "first.": rival.moments.first, "second.": rival.moments.second}
            for part, kept in parts.items():
                arrays |= {f"rival.{part}{name}": array for name, array in kept.arrays().items()}
            arrays |= {f"rival.statistics.{name}": array for name, array in rival.statistics.items()}
        arrays["search"] = json.dumps(about)
    with replacing(path) as file:
        np.savez(file, **arrays)


def write_photos(path: Path, state: State, scene: Scene) -> None:
    """photos.json: what was learned about each training photo, by name.

    colours: the rows of the (3, 4) map from the scene's RGB, in [0, 1], to the photo's; viewmat: the refined one,
    world to camera, in the dataset's coordinates.
    """
    content: dict[str, dict[str, Any]] = {view.name: {} for view in scene.train}
    for view in scene.train:
        if state.exposures:
            content[view.name]["colours"] = state.exposures.of(view.name).tolist()
        if state.poses:
            camera = poses.refined(view.camera, state.poses.of(view.name)).translated(-scene.offset)
            content[view.name]["viewmat"] = camera.viewmat.tolist()
    with replacing(path) as file:
        file.write((json.dumps(content, indent=1, ensure_ascii=False) + "\n").encode())


def load_state(path: Path, extent: float, config: TrainConfig) -> State:
    """The state that `save_state` wrote, in a scene of the given extent in world units.

    Raises
    ------
    InputError
        If the file is missing or damaged, or it was made with another configuration.
    """
    arrays = _load_arrays(path)
    try:
        saved, asked = json.loads(str(arrays["config"])), json.loads(json.dumps(asdict(config)))
        # They do not change the result, but for a limit that is reached: whoever ran out of memory lowers it.
        for free in ("device", "checkpoint_every", "eval_every", "memory_limit"):
            saved.pop(free, None), asked.pop(free, None)
        changed = sorted(k for k in asked if asked[k] != saved.get(k))
        state = None if saved != asked else _to_state(arrays, extent, config)
    except (ArithmeticError, AttributeError, KeyError, RecursionError, TypeError, ValueError) as error:
        raise InputError(f"{path}: expected a checkpoint of clsplat, found a damaged file: {error!r}") from error
    if state is None:
        raise InputError(f"{path}: expected the configuration it was made with, found other {', '.join(changed)}")
    return state


def _to_state(arrays: dict[str, NDArray[Any]], extent: float, config: TrainConfig) -> State:
    def part(name: str, like: Gaussians | None = None) -> Gaussians:
        gaussians = Gaussians(**{k: arrays[f"{name}.{k}"] for k in Gaussians.__dataclass_fields__}).validate()
        for field, array in gaussians.arrays().items():
            if array.dtype != np.float32 or array.shape != (like or gaussians).arrays()[field].shape:
                raise ValueError(f"{name}.{field} of type {array.dtype} and shape {array.shape}")
        return gaussians

    def kept(gaussians: str, prefix: str) -> Kept:
        rows = part(gaussians)
        statistics = STRATEGIES[config.strategy](config, extent, len(rows)).statistics
        for name, fresh in statistics.items():
            array = statistics[name] = arrays[f"{prefix}statistics.{name}"]
            if array.dtype != fresh.dtype or array.shape != fresh.shape:
                raise ValueError(f"{prefix}statistics.{name} of type {array.dtype} and shape {array.shape}")
        return Kept(rows, Moments(part(f"{prefix}first", rows), part(f"{prefix}second", rows)), statistics)

    now, search = kept("gaussians", ""), None
    strategy = STRATEGIES[config.strategy](config, extent, len(now.gaussians))
    strategy.statistics = now.statistics
    numbers = int(arrays["iteration"]), float(arrays["seconds"]), extent
    if "search" in arrays:
        saved = json.loads(str(arrays["search"]))
        trials = [Trial(grows, Point(*smaller), Point(*larger)) for grows, smaller, larger in saved["trials"]]
        degrees = [Point(*p) for p in saved["degrees"]]
        search = Search(saved["most"], trials, degrees, saved["settled"], saved["seen"])
        if "rival" in saved:
            search.rival = Rival(kept("rival", "rival."), Point(*saved["rival"]))
    state = State(*numbers, now.gaussians, now.moments, strategy, float(arrays["intersections"]), search)
    state.pixels = arrays.get("pixels")
    for name in ("exposures", "poses"):
        learned = {k.removeprefix(f"{name}."): a for k, a in arrays.items() if k.startswith(f"{name}.")}
        if learned:
            setattr(state, name, PerPhoto.restored(learned))
    return state


def _load_arrays(path: Path) -> dict[str, NDArray[Any]]:
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            if any(member.file_size > member.compress_size for member in members):
                raise ValueError("compressed arrays")  # NumPy's savez leaves them as they are
            return {member.filename.removesuffix(".npy"): _array(archive.read(member)) for member in members}
    except FileNotFoundError as error:
        raise InputError(
            f"{path}: expected a checkpoint to resume from, found none; start without --resume"
        ) from error
    except (EOFError, NotImplementedError, OSError, RuntimeError, ValueError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: expected a checkpoint of clsplat, found a damaged file: {error}") from error


def _array(content: bytes) -> NDArray[Any]:
    """The array of an .npy file. NumPy's own reader allocates whatever the header says, before it looks for it."""
    file = io.BytesIO(content)
    try:
        if np.lib.format.read_magic(file) != (1, 0):
            raise ValueError("an array in another version of NumPy's format")
        shape, fortran_order, dtype = np.lib.format.read_array_header_1_0(file)
    except (
        Exception
    ) as error:  # the header is Python, and is parsed as such: SyntaxError, TokenError, MemoryError ...
        raise ValueError(f"an array whose header cannot be read: {error}") from error
    if dtype.hasobject or math.prod(shape) * dtype.itemsize != len(content) - file.tell():
        raise ValueError(f"an array of shape {shape} and type {dtype} in {len(content)} bytes")
    flat = np.frombuffer(content, dtype, offset=file.tell())
    return flat.reshape(shape, order="F" if fortran_order else "C").copy()


@contextmanager
def log_file(path: Path, iteration: int) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Open a log of JSON lines after `iteration`; yields the function that appends a record.

    Lines of later iterations, which a run wrote between its last checkpoint and its end, are dropped: the resumed run
    writes them again.
    """
    kept = []
    if iteration and path.exists():
        for line in path.read_text().splitlines():
            try:
                if json.loads(line)["iteration"] <= iteration:
                    kept.append(line)
            except (json.JSONDecodeError, KeyError):  # the line that was being written when the run was killed
                continue
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{path.parent}: expected a folder that can be written to, found: {error.strerror}"
        ) from error
    with replacing(path) as file:
        file.writelines(f"{line}\n".encode() for line in kept)
    events = event_writer(path.parent / "tensorboard", iteration)
    with path.open("a") as log, closing(events) if events else nullcontext():

        def append(record: dict[str, Any]) -> None:
            log.write(json.dumps(record) + "\n")
            log.flush()
            if events:
                for name in record.keys() - {"iteration"}:
                    events.add_scalar(name, record[name], record["iteration"])

        yield append


def event_writer(folder: Path, iteration: int) -> Any:
    """What writes the log for TensorBoard as well, after an iteration; None where tensorboardX is not installed."""
    try:
        from tensorboardX import SummaryWriter
    except ImportError:
        return None
    # The names of its files tell seconds apart, no more.
    return SummaryWriter(
        str(folder), purge_step=iteration + 1 if iteration else None, filename_suffix=f".{iteration}"
    )
