"""Checkpoints: the state of a training in a file, from which an interrupted run resumes."""

import io
import json
import math
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.atomic import replacing
from clsplat.config import TrainConfig
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.inputs import Inputs
from clsplat.ranges import flags_of
from clsplat.renderer import download, fetch
from clsplat.resuming import FREE
from clsplat.scene import Scene
from clsplat.training import photo_exposures, photo_poses
from clsplat.training.autosize.rule import Candidate, Search, SmallSide
from clsplat.training.densify import STRATEGIES
from clsplat.training.moving_files import packed, unpacked
from clsplat.training.optimizer import Moments
from clsplat.training.photo_parameters import PerPhoto
from clsplat.training.photo_poses import refined
from clsplat.training.presets import with_settings
from clsplat.training.rows import Rows
from clsplat.training.smoothing_filter import SmoothingFilter
from clsplat.training.state import State

FORMAT = 3
"""Version of the arrays in a checkpoint. The first had no number; the second added the inputs and the losses, the
third adds the gains of the photos."""

SEARCH = ("most", "pace", "grows", "trials", "degrees", "settled", "validated")
"""Fields of a search that are saved as JSON."""

Arrays = dict[str, NDArray[Any]]


def save_state(path: Path, state: State, config: TrainConfig) -> None:
    """Write the state to an .npz file, whole or not at all."""
    arrays: dict[str, Any] = {"format": FORMAT, "iteration": state.iteration, "seconds": state.seconds}
    arrays["intersections"] = state.intersections
    arrays["losses"] = np.array(state.losses, np.float64)
    arrays["inputs"] = json.dumps(asdict(state.inputs))
    arrays["config"] = json.dumps(asdict(config), sort_keys=True)
    arrays |= _rows_arrays(state.rows, "")
    if state.filter and state.filter.pixels is not None:
        arrays["pixels"] = download(state.filter.pixels)
    for part, learned in (("exposures", state.exposures), ("poses", state.poses)):
        if learned:
            arrays |= {f"{part}.{name}": array for name, array in learned.arrays().items()}
    if search := state.search:
        about = {name: getattr(search, name) for name in SEARCH}
        if search.small_side:
            about["small_side"] = search.small_side.candidate
            arrays |= _rows_arrays(search.small_side.rows, "small_side.")
        arrays["search"] = json.dumps(about)
    with replacing(path) as file:
        np.savez(file, **arrays, **packed(state.moving))


def _rows_arrays(rows: Rows, prefix: str) -> dict[str, Any]:
    parts = {"gaussians": rows.gaussians, "first": rows.moments.first, "second": rows.moments.second}
    arrays: dict[str, Any] = {
        f"{prefix}{part}.{name}": array
        for part, gaussians in parts.items()
        for name, array in fetch(gaussians).arrays().items()
    }
    statistics = rows.strategy.statistics
    return arrays | {f"{prefix}statistics.{name}": download(array) for name, array in statistics.items()}


def write_photos(path: Path, state: State, scene: Scene) -> None:
    """Write photos.json: the learned parameters of each training photo, by name.

    colours: the rows of the (3, 4) map from the scene's RGB, in [0, 1], to the photo's; curve and falloff, with
    ``--response``: the terms that docs/stages/exposure.md defines, per channel; viewmat: the refined one, world to
    camera, in the dataset's coordinates.
    """
    content: dict[str, dict[str, Any]] = {view.name: {} for view in scene.train}
    for view in scene.train:
        if state.exposures:
            learned = state.exposures.of(view.name)
            content[view.name]["colours"] = learned[:, :4].tolist()
            if learned.shape[1] > 4:
                content[view.name] |= {"curve": learned[:, 4].tolist(), "falloff": learned[:, 5].tolist()}
        if state.poses:
            camera = refined(view.camera, state.poses.of(view.name)).translated(-scene.offset)
            content[view.name]["viewmat"] = camera.viewmat.tolist()
    with replacing(path) as file:
        file.write((json.dumps(content, indent=1) + "\n").encode())


def load_state(path: Path, extent: float, config: TrainConfig, inputs: Inputs | None = None) -> State:
    """Read the state that `save_state` wrote.

    Parameters
    ----------
    path : Path
    extent : float
        Scale of the scene, world units.
    config : TrainConfig
    inputs : Inputs, optional
        Inputs of the run that continues from the state; None if no run does.

    Raises
    ------
    InputError
        If the file is missing or damaged, or it was made from other inputs, with another configuration or by another
        version of clsplat.

    Warns
    -----
    UserWarning
        If the device or its driver differs.
    """
    arrays = _load_arrays(path)
    with _damage_named(path):
        version = int(arrays.get("format", 1))
    if version != FORMAT:
        raise InputError(
            f"{path}: expected a checkpoint of format {FORMAT}, found format {version} of another version; "
            "continue it with that version, or start a new run in another folder"
        )
    with _damage_named(path):
        made_from = Inputs.restored(json.loads(str(arrays["inputs"])))
    if inputs is not None:
        made_from = made_from.continued(inputs, path)
    with _damage_named(path):
        saved = json.loads(str(arrays["config"]))
    demand_same(with_settings(TrainConfig(), saved, str(path)), config, path)
    with _damage_named(path):
        state = _to_state(arrays, extent, config)
    for learned in (state.exposures, state.poses):
        if learned and made_from.train and sorted(learned.names) != sorted(made_from.train):
            raise InputError(
                f"{path}: expected a checkpoint of clsplat, found a damaged file: parameters of other photos"
            )
    state.inputs = made_from
    return state


def demand_same(saved: TrainConfig, asked: TrainConfig, source: Path) -> None:
    """Raise an InputError with their flags if settings differ on which the result depends."""
    saved, asked = without_free(saved), without_free(asked)
    if saved != asked:
        expected, found = flags_of(saved, asked), flags_of(asked, saved)
        raise InputError(
            f"{source}: expected the configuration it was made with, {' '.join(expected)}, found {' '.join(found)}; "
            "repeat its flags, or start a new run in another folder"
        )


def without_free(config: TrainConfig) -> TrainConfig:
    """A configuration with the defaults of all settings that may differ when a run resumes.

    Masks and depth maps are compared by their content (`clsplat.inputs`), so that they may have moved.
    """
    default = TrainConfig()
    data = replace(config.data, masks=None, depth=None)
    return replace(config, data=data, **{name: getattr(default, name) for name in FREE})


@contextmanager
def _damage_named(path: Path) -> Iterator[None]:
    try:
        yield
    except (ArithmeticError, AttributeError, KeyError, RecursionError, TypeError, ValueError) as error:
        raise InputError(f"{path}: expected a checkpoint of clsplat, found a damaged file: {error!r}") from error


def _to_state(arrays: Arrays, extent: float, config: TrainConfig) -> State:
    search = None
    if "search" in arrays:
        saved, small_side = json.loads(str(arrays["search"])), None
        if "small_side" in saved:
            candidate = Candidate.restored(saved["small_side"])
            small_side = SmallSide(_to_rows(arrays, "small_side.", extent, config), candidate)
        search = Search.restored(saved, small_side)
    iteration, rows = arrays["iteration"], _to_rows(arrays, "", extent, config)
    if iteration.dtype.kind != "i" or not 0 <= iteration <= (config.iterations or iteration):
        raise ValueError(f"iteration {iteration} of {config.iterations}")
    for name in ("seconds", "intersections", "losses"):
        array = arrays[name]
        if array.dtype != np.float64 or array.ndim != (name == "losses") or not np.isfinite(array).all():
            raise ValueError(f"{name} = {array}")
    pixels = arrays.get("pixels")
    if pixels is not None and (pixels.dtype != np.float32 or pixels.shape != (len(rows.gaussians),)):
        raise ValueError(f"pixels of type {pixels.dtype} and shape {pixels.shape}")
    exposures_of = partial(photo_exposures.start, response=config.response)
    return State(
        iteration=int(iteration),
        seconds=float(arrays["seconds"]),
        extent=extent,
        rows=rows,
        intersections=float(arrays["intersections"]),
        losses=[float(loss) for loss in arrays["losses"]],
        search=search,
        exposures=_to_photo_parameters(arrays, "exposures.", exposures_of) if config.exposure else None,
        poses=_to_photo_parameters(arrays, "poses.", photo_poses.start) if config.poses else None,
        filter=SmoothingFilter(pixels) if config.filter_3d else None,
        moving=unpacked(arrays),
    )


def _with_prefix(arrays: Arrays, prefix: str) -> Arrays:
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


def _to_photo_parameters(arrays: Arrays, prefix: str, start: Callable[[list[str]], PerPhoto]) -> PerPhoto:
    return PerPhoto.restored(_with_prefix(arrays, prefix), start)


def _to_rows(arrays: Arrays, prefix: str, extent: float, config: TrainConfig) -> Rows:
    gaussians = _to_gaussians(arrays, f"{prefix}gaussians.")
    moments = Moments(*(_to_gaussians(arrays, f"{prefix}{part}.", gaussians) for part in ("first", "second")))
    strategy = STRATEGIES[config.strategy](config, extent, len(gaussians))
    strategy.restore(_with_prefix(arrays, f"{prefix}statistics."))
    return Rows(gaussians, moments, strategy)


def _to_gaussians(arrays: Arrays, prefix: str, like: Gaussians | None = None) -> Gaussians:
    gaussians = Gaussians(**{name: arrays[prefix + name] for name in Gaussians.__dataclass_fields__}).validate()
    for name, array in gaussians.arrays().items():
        if array.dtype != np.float32 or array.shape != (like or gaussians).arrays()[name].shape:
            raise ValueError(f"{prefix}{name} of type {array.dtype} and shape {array.shape}")
        if not np.isfinite(array).all():  # a run that diverges saves no checkpoint
            raise ValueError(f"{prefix}{name} with values that are not finite")
    return gaussians


def _load_arrays(path: Path) -> Arrays:
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            if any(member.file_size > member.compress_size for member in members):
                raise ValueError("compressed arrays")  # NumPy's savez leaves them as they are
            return {member.filename.removesuffix(".npy"): _array(archive.read(member)) for member in members}
    except FileNotFoundError as error:
        raise no_checkpoint(path.parent) from error
    except (EOFError, NotImplementedError, OSError, RuntimeError, ValueError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: expected a checkpoint of clsplat, found a damaged file: {error}") from error


def no_checkpoint(out: Path) -> InputError:
    """The error of a folder that no run can resume in."""
    return InputError(
        f"{out}: expected a checkpoint to resume from, found none; start the run without --resume, or name its "
        "folder with -o"
    )


def _array(content: bytes) -> NDArray[Any]:
    """The array of an .npy file. NumPy's own reader allocates what the header declares before it reads the data."""
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
