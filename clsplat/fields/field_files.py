"""Files of fields: the model that renders, and the checkpoint from which an interrupted training resumes."""

import json
import zipfile
import zlib
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from clsplat.atomic import replacing
from clsplat.config import TrainConfig
from clsplat.errors import InputError
from clsplat.fields.field import Field
from clsplat.fields.space import Space
from clsplat.inputs import Inputs
from clsplat.resuming import FREE

if TYPE_CHECKING:
    from clsplat.device import Device

MODEL = "field.npz"
"""Name of the file of the model in the folder of a run."""

DAMAGES = AttributeError, EOFError, KeyError, OSError, RuntimeError, TypeError, ValueError
"""What reading a damaged file raises, beside the errors of archives. RuntimeError: for an encryption or compression
that Python does not know."""


def save_field(path: Path, field: Field) -> None:
    """Write the model of a field, whole or not at all, its tables in half precision: `finish` has rounded them."""
    arrays = {
        name: array.astype(np.float16) if name in field.halved else array for name, array in field.model().items()
    }
    _write(path, arrays | {"about": np.array(json.dumps(_about(field)))})


def save_checkpoint(
    path: Path, field: Field, config: TrainConfig, inputs: Inputs, seconds: float, losses: list[float]
) -> None:
    """Write everything that further training depends on, whole or not at all; `losses` are those not yet logged."""
    about = _about(field) | {"config": _compared(config), "inputs": asdict(inputs)}
    about |= {"seconds": seconds, "losses": losses}
    _write(path, field.model() | field.optimiser() | {"about": np.array(json.dumps(about))})


def _write(path: Path, arrays: dict[str, Any]) -> None:
    with replacing(path) as file:
        np.savez(file, **arrays)


def _about(field: Field) -> dict[str, Any]:
    space = asdict(field.space) | {"centre": field.space.centre.tolist()}
    return {"method": field.name, "space": space, "iteration": field.iteration, "seed": field.seed}


def _compared(config: TrainConfig) -> dict[str, Any]:
    config = replace(config, data=replace(config.data, masks=None))  # compared by content, as they may have moved
    return {name: value for name, value in json.loads(json.dumps(asdict(config))).items() if name not in FREE}


def load_field(path: Path | str, methods: dict[str, type[Field]], device: "Device") -> Field:
    """Read the field that `save_field` wrote.

    Raises
    ------
    InputError
        If the file is missing or damaged.
    """
    return _read(Path(path), methods, device)[0]


def load_checkpoint(
    path: Path, method: type[Field], config: TrainConfig, inputs: Inputs, device: "Device"
) -> tuple[Field, float, list[float]]:
    """Read what `save_checkpoint` wrote: the field, its training time in seconds, and the losses not yet logged.

    Raises
    ------
    InputError
        If the file is missing or damaged, or of another method, configuration or dataset.

    Warns
    -----
    UserWarning
        If it was made on another device.
    """
    field, about = _read(path, {method.name: method}, device)
    if about.get("config") != _compared(config):
        raise InputError(f"{path}: expected the configuration it was made with, found another one")
    try:
        made_from = Inputs.restored(about["inputs"])
        seconds, losses = float(about["seconds"]), [float(loss) for loss in about["losses"]]
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: expected a checkpoint of clsplat, found a damaged file: {error!r}") from error
    made_from.continued(inputs, path)
    return field, seconds, losses


def _read(path: Path, methods: dict[str, type[Field]], device: "Device") -> tuple[Field, dict[str, Any]]:
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            arrays = dict(file)
        about = json.loads(str(arrays.pop("about")))
        if about["method"] not in methods:
            raise InputError(f"{path}: expected a field of {', '.join(methods)}, found one of {about['method']}")
        space = Space(**about["space"] | {"centre": np.array(about["space"]["centre"], np.float64)})
        field = methods[about["method"]](space, device, int(about["seed"]))
        field.iteration = int(about["iteration"])
        field.restore(arrays)
    except FileNotFoundError as error:
        raise InputError(f"{path}: expected a field, found no file") from error
    except (*DAMAGES, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{path}: expected a field of clsplat, found a damaged file: {error!r}") from error
    return field, about
