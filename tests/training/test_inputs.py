"""The inputs of a run: a checkpoint goes on with the photos, cameras and points it was made from, or not at all."""

import json
import re
import warnings
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_run import CONFIG, SIZE

from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.inputs import Inputs
from clsplat.scene import DepthMap, Scene, View
from clsplat.training.checkpoint import load_state
from clsplat.training.loop import train

SHORT = replace(CONFIG, iterations=8, checkpoint_every=4)


def with_view(scene: Scene, i: int, change: Callable[[View], View]) -> Scene:
    return replace(scene, train=[*scene.train[:i], change(scene.train[i]), *scene.train[i + 1 :]])


def one_pixel(view: View) -> View:
    image = view.image.copy()
    image[3, 4, 2] ^= 1
    return replace(view, image=image)


def moved(view: View) -> View:
    return replace(view, camera=view.camera.translated(np.array([0, 1e-6, 0])))


def other_points(scene: Scene) -> Scene:
    points = scene.points.copy()
    points[0, 0] += 1e-6
    return replace(scene, points=points)


MASK = np.ones((SIZE[1], SIZE[0]), bool)
CLEAR = np.zeros((SIZE[1], SIZE[0]), np.uint8)
DIFFERENCES: dict[str, tuple[Callable[[Scene], Scene], str]] = {
    "inverted": (
        lambda s: replace(s, train=[replace(v, image=255 - v.image) for v in s.train]),
        r"other pixels \(\S+, \S+, \S+ and 9 more\)",
    ),
    "deleted": (lambda s: replace(s, train=s.train[3:]), r"fewer photos \(\S+, \S+, \S+\)"),
    "added": (
        lambda s: replace(s, train=[*s.train, replace(s.train[0], name="z.png")]),
        r"more photos \(z\.png\)",
    ),
    "held out": (
        lambda s: replace(s, train=s.train[1:], test=[s.train[0], *s.test]),
        r"another choice of held-out photos \(\S+\)",
    ),
    "one bit": (lambda s: with_view(s, 2, one_pixel), r"other pixels \(\S+\)"),
    "transparency": (lambda s: with_view(s, 2, lambda v: replace(v, clear=CLEAR)), r"other pixels \(\S+\)"),
    "depth map": (
        lambda s: with_view(s, 2, lambda v: replace(v, depth=DepthMap(np.ones((SIZE[1], SIZE[0]), np.float32)))),
        r"other depth maps \(\S+\)",
    ),
    "mask": (lambda s: with_view(s, 2, lambda v: replace(v, mask=MASK)), r"other masks \(\S+\)"),
    "pose": (lambda s: with_view(s, 2, moved), r"other cameras \(\S+\)"),
    "lens": (
        lambda s: with_view(s, 2, lambda v: replace(v, camera=replace(v.camera, fx=v.camera.fx * (1 + 1e-6)))),
        r"other cameras \(\S+\)",
    ),
    "model": (
        lambda s: with_view(s, 2, lambda v: replace(v, camera=replace(v.camera, model="fisheye"))),
        r"other cameras \(\S+\)",
    ),
    "near plane": (
        lambda s: with_view(s, 2, lambda v: replace(v, camera=replace(v.camera, near=0.5))),
        r"other cameras \(\S+\)",
    ),
    "world": (
        lambda s: replace(s, offset=np.array([0, 0, 5.0])),
        r"other cameras \(\S+, \S+, \S+ and \d+ more\)",
    ),
    "points": (other_points, "other points"),
    "no points": (lambda s: replace(s, points=s.points[:0], colors=s.colors[:0]), "other points"),
    "colours": (lambda s: replace(s, colors=s.colors + np.uint8(1)), "other points"),
    "two at once": (lambda s: other_points(with_view(s, 0, one_pixel)), r"other pixels \(\S+\), and other points"),
}


@pytest.mark.parametrize("difference", DIFFERENCES)
def test_other_inputs_are_refused_by_name(scene: Scene, device: Device, tmp_path: Path, difference: str) -> None:
    train(scene, replace(SHORT, iterations=4), tmp_path, device)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()}
    change, found = DIFFERENCES[difference]
    message = rf"checkpoint\.npz: expected the dataset it was made with, found {found}; name that dataset, or start"
    with pytest.raises(InputError, match=message):
        train(change(scene), replace(SHORT, iterations=4), tmp_path, device, resume=True)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()} == before


def test_the_same_inputs_from_another_place_go_on(scene: Scene, device: Device, tmp_path: Path) -> None:
    """Arrays of another layout, and poses to rounding, as on another machine."""
    expected = train(scene, SHORT, tmp_path / "whole", device)

    def loaded_again(view: View) -> View:
        matrix = view.camera.viewmat * (1 + 1e-15)
        return replace(view, image=np.asfortranarray(view.image), camera=replace(view.camera, viewmat=matrix))

    def kill(record: dict[str, Any]) -> None:
        if record["iteration"] == 6:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        train(scene, SHORT, tmp_path / "cut", device, progress=kill)
    again = replace(scene, train=[loaded_again(v) for v in scene.train])
    resumed = train(again, SHORT, tmp_path / "cut", device, resume=True)
    assert len(resumed) == len(expected)


def test_another_device_or_driver_warns_and_goes_on(
    scene: Scene, device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(record: dict[str, Any]) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Device, "label", "Another platform: another device")
        with pytest.raises(KeyboardInterrupt):
            train(scene, SHORT, tmp_path, device, progress=interrupt)
    driver = device.cl_device.driver_version.strip()
    message = re.escape(
        f"the checkpoint was made on Another platform: another device, driver {driver}; the run continues on "
        f"{device.label}, driver {driver}: its bits will differ"
    )
    with pytest.warns(UserWarning, match=message), pytest.raises(KeyboardInterrupt):
        train(scene, SHORT, tmp_path, device, resume=True, progress=interrupt)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # the device of the last checkpoint counts
        train(scene, SHORT, tmp_path, device, resume=True)


def test_an_older_checkpoint_is_refused_in_a_sentence(scene: Scene, device: Device, tmp_path: Path) -> None:
    train(scene, SHORT, tmp_path, device)
    path = tmp_path / "checkpoint.npz"
    with np.load(path) as file:
        arrays = dict(file)
    added = {name: arrays.pop(name) for name in ("format", "inputs", "losses")}
    np.savez(path, **arrays)
    with pytest.raises(
        InputError, match=r"checkpoint\.npz: expected a checkpoint of format 3, found format 1 of another"
    ):
        load_state(path, scene.extent, SHORT)
    np.savez(path, **arrays, **(added | {"format": np.array(4)}))
    with pytest.raises(InputError, match="found format 4 of another version; continue it with that version, or"):
        load_state(path, scene.extent, SHORT)
    for damage in ('{"train": 1}', '{"train": {"a": [1, 2, "x"]}, "test": {}}', "[]", "{", '{"more": 1}'):
        np.savez(path, **arrays, **(added | {"inputs": np.array(damage)}))
        with pytest.raises(InputError, match="found a damaged file"):
            load_state(path, scene.extent, SHORT)


def test_inputs_survive_json(scene: Scene, device: Device) -> None:
    inputs = Inputs.of(scene, device)
    assert Inputs.restored(json.loads(json.dumps(asdict(inputs)))) == inputs
    assert inputs.points and len(inputs.train) == len(scene.train)


def test_poses_are_compared_in_the_unit_of_the_scene(scene: Scene, device: Device) -> None:
    """A pose that is off by a thousandth, in a scene of 10^-8 units."""

    def scaled(s: Scene, unit: float) -> Scene:
        def view(v: View) -> View:
            viewmat = v.camera.viewmat.copy()
            viewmat[:3, 3] *= unit
            return replace(v, camera=replace(v.camera, viewmat=viewmat))

        return replace(s, train=[view(v) for v in s.train], test=[view(v) for v in s.test])

    old = Inputs.of(scaled(scene, 1e-8), device)
    assert old.continued(Inputs.of(scaled(scene, 1e-8 * (1 + 1e-12)), device), Path("checkpoint.npz"))
    with pytest.raises(InputError, match="other cameras"):
        old.continued(Inputs.of(scaled(scene, 1.001e-8), device), Path("checkpoint.npz"))
