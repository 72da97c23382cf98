"""Run folders as arguments: the scene that `train` wrote, with its dataset and the settings of both."""

from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, TypeVar

from clsplat.commands.console import say, warn
from clsplat.commands.options import CameraOptions, PhotoOptions
from clsplat.config import DataConfig, RenderConfig, TrainConfig
from clsplat.errors import InputError
from clsplat.ranges import checked, name_in

if TYPE_CHECKING:
    from clsplat.scene import Scene

CONFIG, SCENE, FRAMES = "config.json", "scene.ply", "frames"
"""Files of a run: its settings and its scene; and the folder of a video's photos."""

MethodName = Annotated[str, name_in("clsplat.fields:method_names")]
"""Type of the flag --method."""

Command = TypeVar("Command")
Part = TypeVar("Part", bound=DataConfig | RenderConfig)


class Run(NamedTuple):
    """A folder that `train` wrote: dataset and radiance field, if config.json names them, and settings."""

    data: Path | None
    config: TrainConfig
    method: str | None = None


def is_run(path: Path) -> bool:
    """Whether a path is the folder of a run."""
    return path.is_dir() and (path / CONFIG).is_file()


def read_run(folder: Path) -> Run:
    """Read which dataset a run was trained on, and how.

    Raises
    ------
    InputError
        If config.json cannot be read.
    """
    return read_config(folder / CONFIG)


def read_config(file: Path) -> Run:
    """Read the config.json of a run, or a file of settings in the same form; errors as of `load_config`."""
    from clsplat.training.presets import DATA_PATH, METHOD, config_in, read_settings

    settings = read_settings(file)
    named, method = settings.get(DATA_PATH), None
    if METHOD in settings:
        method = checked(settings[METHOD], MethodName, f"{file}: {METHOD}")
    # A dataset within the folder of the run moves with it.
    data = photos_of(file.parent / named, file.parent) if isinstance(named, str) else None
    return Run(data, config_in(settings, file), method)


def as_trained(scene: "Scene", folder: Path, config: TrainConfig) -> "Scene":
    """The scene of a run with its training photos as they were at the end of the training: evened out, and without
    what moves. Exposures are not applied."""
    from clsplat.dataset.brightness import evened, gains
    from clsplat.training.moving import still
    from clsplat.training.moving_files import load_masks

    if config.even_brightness and not config.exposure:
        scene = evened(replace(scene, gains=gains(scene)))
    return replace(scene, train=still(scene.train, load_masks(folder)))


def check_method(folder: Path, method: str) -> None:
    """Raise an InputError if the run in a folder, which is to resume, trains something else."""
    from clsplat.training.presets import METHOD, read_settings

    began = read_settings(folder / CONFIG).get(METHOD, "gaussians") if is_run(folder) else method
    if method != began:
        raise InputError(f"--method: expected {began}, with which the run in {folder} began, found {method}")


def began(out: Path) -> bool:
    """Whether a folder holds a run that can be resumed."""
    from clsplat.blocks.whole import BLOCKS
    from clsplat.resuming import CHECKPOINT

    return (out / CHECKPOINT).is_file() or (out / BLOCKS).is_dir()


def check_new(out: Path, resume: bool) -> None:
    """Raise an InputError if a folder holds a run and none resumes.

    A run that ended before its first checkpoint is none yet: the same command starts it again.
    """
    from clsplat.fields.field_files import MODEL

    if resume:
        return
    if began(out):
        raise InputError(
            f"{out}: holds a run already; --resume continues it, another folder after -o starts a new one"
        )
    for name in (SCENE, MODEL):
        if (out / name).exists():
            raise InputError(f"{out}: expected a folder without {name}, found one; choose another folder with -o")


def check_apart(data: Path, out: Path, config: DataConfig) -> None:
    """Raise an InputError if the pictures of a run would lie among photos without cameras, and count as photos."""
    from clsplat.dataset.loading import PHOTOS, RECOVERED, detect
    from clsplat.dataset.photos import photo_folder

    folder, run = photo_folder(data).resolve(), out.resolve()
    # Only the folder `images` is searched with the folders in it.
    among = run == folder or (photo_folder(data) != data and run.is_relative_to(folder))
    if data.is_dir() and among and detect(data, config)[0] in (PHOTOS, RECOVERED):
        raise InputError(
            f"{out}: expected a folder apart from the photos, among which the pictures of a run would count as "
            f"photos; use -o {data / 'run'}"
        )


def photos_of(data: Path, folder: Path) -> Path:
    """The photos of a run: its dataset, or if that is a video, the folder of the frames extracted from it."""
    from clsplat.dataset.video import is_video

    return folder / FRAMES if is_video(data) else data


def extracted(data: Path, folder: Path) -> Path:
    """The photos of a run; those of a video are extracted, unless they are there already."""
    from clsplat.dataset.video import extract_frames

    photos = photos_of(data, folder)
    if photos != data:
        say(f"{photos}: {extract_frames(data, photos)} frames of {data.name}")
    return photos


def scene_file(path: Path) -> Path:
    """The file of Gaussians that an argument names, which may be the folder of a run.

    Raises
    ------
    InputError
        If the run has none yet, or is one of a radiance field.
    """
    if not is_run(path):
        return path
    if not (path / SCENE).is_file():
        if method := read_run(path).method:
            raise InputError(
                f"{path}: expected a run of Gaussians, found one of the radiance field {method}, of which only train "
                "and info know"
            )
        raise InputError(
            f"{path}: expected a finished run, found no {SCENE} in it; it is in progress, or --resume finishes it"
        )
    return path / SCENE


def with_run(command: Command, dataset: str = "data") -> Command | None:
    """A command with the dataset and the settings of the run that it names as defaults; None if it names none.

    Parameters
    ----------
    command : dataclass
        With the fields `scene`, `data_config`, maybe `render`, and the one that `dataset` names.
    """
    given: Any = command
    if not is_run(given.scene):
        return None
    run = read_run(given.scene)
    changes: dict[str, Any] = {"data_config": _photos(given.data_config, run.config)}
    if hasattr(given, "render"):
        changes["render"] = _with(given.render, run.config.render)
    if getattr(given, dataset) is None and run.data is not None:
        if run.data.is_dir():
            changes[dataset] = run.data
        else:
            warn(f"warning: {run.data}, the dataset of {given.scene}, is missing")
    result: Command = replace(given, **changes)
    return result


def _photos(part: PhotoOptions, config: TrainConfig) -> PhotoOptions:
    """The photos' settings of a run, without the folders of files that the command does not read."""
    masks = None if isinstance(part, CameraOptions) else config.data.masks
    return replace(_with(part, config.data), masks=masks, depth=None, triangulate=config.init.triangulate)


def _with(part: Part, settings: Any) -> Part:
    """A part of a configuration with the values of the whole one."""
    return replace(part, **{f.name: getattr(settings, f.name) for f in fields(settings)})


def dataset_of(command: str, data: Path | None) -> Path:
    """The dataset of a command that needs one.

    Raises
    ------
    InputError
        If there is none.
    """
    if data is None:
        raise InputError(
            f"{command}: expected a dataset or the folder of a run that has one, as in: clsplat {command} scene.ply "
            "DATASET; found none"
        )
    return data


def place_of(out: Path | None, scene: Path, name: str) -> Path:
    """The folder of a result: the one given, or `name` within the folder of the run.

    Raises
    ------
    InputError
        If there is neither.
    """
    if out is not None:
        return out
    if not is_run(scene):
        raise InputError(
            "-o: expected a folder for the result, found none; only the folder of a run has a place for it"
        )
    return scene / name
