"""Whole training configurations as data: the presets (the JSON files of this folder), and the config.json of a run.

Belongs here: reading and writing configurations. Does not belong here: the meaning of a setting and its default
(`clsplat.config`).
"""

import json
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import yaml

from clsplat.config import TrainConfig
from clsplat.errors import InputError
from clsplat.ranges import checked, shown

FOLDER = Path(__file__).parent

PRESETS = tuple(sorted(path.stem for path in FOLDER.glob("*.json")))
"""Names of the presets."""

YAML = (".yaml", ".yml")
"""Suffixes of files in YAML; other files are JSON."""

DATA_PATH = "data_path"
"""Key in config.json for the path of the dataset, which is not a part of the configuration."""

METHOD = "method"
"""Key in config.json for the name of the radiance field, in the runs of fields; not a part of the configuration."""

Settings = TypeVar("Settings")


def load_preset(name: str) -> TrainConfig:
    """Read a preset by its name.

    Raises
    ------
    InputError
        If there is no such preset.
    """
    if name not in PRESETS:
        raise InputError(f"--preset: expected one of {', '.join(PRESETS)}, found {name!r}")
    return load_config(FOLDER / f"{name}.json")


def load_config(path: Path) -> TrainConfig:
    """Read a configuration from a JSON or YAML file: the config.json of a run, or a part of one.

    Parameters
    ----------
    path : Path
        Nested as config.json is; missing settings have their defaults.

    Raises
    ------
    InputError
        If the file cannot be read or is not an object of settings, if `TrainConfig` has no such setting, or if a
        value has another type, is not among its choices or is out of range; the message names file and setting. If
        the settings are those of a radiance field.
    """
    settings = read_settings(path)
    if METHOD in settings:
        raise InputError(
            f"{path}: {METHOD}: expected settings of Gaussians, which have none, found {shown(settings[METHOD])}; "
            "give the config.json of a run of Gaussians"
        )
    return config_in(settings, path)


def config_in(settings: dict[str, Any], path: Path) -> TrainConfig:
    """Make the configuration of the settings in a file; errors as of `load_config`, but a field may have them."""
    own = {name: value for name, value in settings.items() if name not in (DATA_PATH, METHOD)}
    return with_settings(TrainConfig(), own, str(path))


def read_settings(path: Path) -> dict[str, Any]:
    """Read the object in a file of JSON or, by its suffix, YAML; each key must occur once."""

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        names = [name for name, _ in pairs]
        for name in names:
            if names.count(name) > 1:
                raise InputError(f"{path}: {name}: expected it once, found it {names.count(name)} times")
        return dict(pairs)

    class Loader(yaml.SafeLoader):
        """YAML loader that makes the same objects as JSON."""

        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            named = isinstance(node, yaml.MappingNode)
            if not named or not all(isinstance(key, yaml.ScalarNode) for key, _ in node.value):
                raise yaml.constructor.ConstructorError(None, None, "expected settings by name", node.start_mark)
            return once(
                [(str(self.construct_object(key)), self.construct_object(value, True)) for key, value in node.value]
            )

    try:
        text = path.read_text(encoding="utf-8")
        if path.suffix in YAML:
            settings = yaml.load(text, Loader)
        else:
            settings = json.loads(text, object_pairs_hook=once)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error
    except InputError:
        raise
    # PyYAML raises errors of many kinds for values such as the date 2020-13-45.
    except (yaml.YAMLError, ArithmeticError, AttributeError, RecursionError, TypeError, ValueError) as error:
        kind = "YAML" if path.suffix in YAML else "JSON"
        raise InputError(f"{path}: expected {kind}, found: {' '.join(str(error).split())}") from error
    if not isinstance(settings, dict):
        raise InputError(f"{path}: expected an object of settings, found {shown(settings)}")
    return settings


def with_settings(base: Settings, settings: dict[str, Any], source: str, within: str = "") -> Settings:
    """Change some settings of a configuration.

    Parameters
    ----------
    base : a dataclass of clsplat.config
    settings : dict
        Values by name, nested as the dataclasses are; missing settings stay as in `base`.
    source : str
        Origin of the settings in messages, such as a file.
    within : str
        Name of `base` within the whole configuration, with a dot at the end.

    Raises
    ------
    InputError
        If there is no such setting, or a value has another type, is not among its choices or is out of range.
    """
    hints = get_type_hints(type(base), include_extras=True)
    known = {field.name for field in fields(base)}  # type: ignore[arg-type]
    for name in settings:
        if name not in known:
            raise InputError(
                f"{source}: {within}{name}: expected one of {', '.join(sorted(known))}, found no such setting"
            )
    values: dict[str, Any] = {}
    for name, value in settings.items():
        where = f"{source}: {within}{name}"
        if is_dataclass(getattr(base, name)):
            if not isinstance(value, dict):
                raise InputError(f"{where}: expected an object of settings, found {shown(value)}")
            values[name] = with_settings(getattr(base, name), value, source, f"{within}{name}.")
        else:
            values[name] = checked(value, hints[name], where)
    return replace(base, **values)  # type: ignore[type-var]
