"""Files of radiance fields: models, and checkpoints from which runs resume to the bit."""

import json
from dataclasses import replace

import numpy as np
import pytest
from ball_photos import EDGE, ball
from small_fields import ALL, CONFIG, EACH, WHITE, SmallNerf, SmallPlenoxels

from clsplat.config import DataConfig
from clsplat.errors import InputError
from clsplat.fields import METHODS
from clsplat.fields.field_files import MODEL, load_checkpoint, load_field, save_checkpoint, save_field
from clsplat.fields.field_training import train_field
from clsplat.fields.space import Space
from clsplat.inputs import Inputs
from clsplat.resuming import CHECKPOINT, FREE

pytestmark = pytest.mark.usefixtures("long_steps")


@ALL
def test_runs_repeat_and_resume_to_the_bit(device, method, room, tmp_path):
    config, scene = replace(CONFIG, iterations=40), ball(room=room)
    folders = [tmp_path / name for name in ("whole", "again", "interrupted")]
    for folder in folders:
        folder.mkdir()
    whole, again = (train_field(scene, method, config, folder, device) for folder in folders[:2])

    def interrupt(record):
        if record["iteration"] == 23:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_field(scene, method, config, folders[2], device, progress=interrupt)
    resumed = train_field(scene, method, config, folders[2], device, resume=True)
    for other in (again, resumed):
        for name, array in whole.model().items():
            np.testing.assert_array_equal(other.model()[name], array)
    logs = [(folder / "log.jsonl").read_text().splitlines() for folder in folders[1:]]
    lines = [[json.loads(line) | {"seconds": None} for line in log] for log in logs]
    assert [line["iteration"] for line in lines[0]] == [10, 20, 30, 40] and lines[1] == lines[0]


def test_a_last_checkpoint_that_cannot_be_written_leaves_the_field(device, scene, tmp_path):
    (tmp_path / CHECKPOINT).mkdir()  # no file can replace a folder
    with pytest.warns(UserWarning, match="cannot write .*; the field is written next, without it"):
        train_field(scene, SmallNerf, replace(CONFIG, iterations=2), tmp_path, device)
    assert (tmp_path / MODEL).is_file()


@EACH
def test_an_interrupt_within_a_step_leaves_the_last_checkpoint(device, scene, method, tmp_path, monkeypatch):
    """Half of a step is no state from which a run could go on to the same bits."""
    config = replace(CONFIG, iterations=12, checkpoint_every=5)
    (tmp_path / "whole").mkdir()
    whole = train_field(scene, method, config, tmp_path / "whole", device)

    def interrupted(*_):
        raise KeyboardInterrupt

    def evaluate(field):
        if field.iteration == 6:
            field.stages.rays_bwd = interrupted
        return {}

    with pytest.raises(KeyboardInterrupt):
        train_field(scene, method, config, tmp_path, device, evaluate=evaluate)
    inputs = Inputs.of(scene, device)
    assert load_checkpoint(tmp_path / CHECKPOINT, method, config, inputs, device)[0].iteration == 5
    resumed = train_field(scene, method, config, tmp_path, device, resume=True)
    for name, array in whole.model().items():
        np.testing.assert_array_equal(resumed.model()[name], array)


@ALL
def test_the_file_renders_what_was_trained(device, method, room, tmp_path):
    scene = ball(room=room)
    field = train_field(scene, method, replace(CONFIG, iterations=20), tmp_path, device)
    loaded = load_field(str(tmp_path / MODEL), {method.name: method}, device)
    camera = scene.test[0].camera
    np.testing.assert_array_equal(loaded.image(camera, WHITE), field.image(camera, WHITE))
    save_field(tmp_path / "again.npz", loaded)
    first, again = (dict(np.load(tmp_path / name)) for name in (MODEL, "again.npz"))
    for name, array in first.items():
        np.testing.assert_array_equal(again[name], array)


@EACH
def test_another_configuration_does_not_resume(device, scene, method, tmp_path):
    config = replace(CONFIG, iterations=2)
    train_field(scene, method, config, tmp_path, device)
    inputs = Inputs.of(scene, device)
    with pytest.raises(InputError, match="expected the configuration it was made with"):
        load_checkpoint(tmp_path / CHECKPOINT, method, replace(config, seed=1), inputs, device)
    free = {"device": "a", "checkpoint_every": 7, "eval_every": 8, "memory_limit": "9GB"}
    assert free.keys() == set(FREE)
    assert load_checkpoint(tmp_path / CHECKPOINT, method, replace(config, **free), inputs, device)[0].iteration == 2


def test_other_photos_do_not_resume(device, scene, tmp_path):
    config = replace(CONFIG, iterations=2)
    train_field(scene, SmallNerf, config, tmp_path, device)
    first, *others = scene.train
    negative = replace(scene, train=[replace(first, image=255 - first.image), *others])
    with pytest.raises(InputError, match=rf"expected the dataset it was made with, found other pixels.*{first.name}"):
        train_field(negative, SmallNerf, config, tmp_path, device, resume=True)
    with pytest.raises(InputError, match="found fewer photos"):
        train_field(replace(scene, train=others), SmallNerf, config, tmp_path, device, resume=True)


def test_masks_may_move(device, scene, tmp_path):
    config = replace(CONFIG, iterations=2, data=DataConfig(masks="/a/masks"))
    train_field(scene, SmallNerf, config, tmp_path, device)
    moved = replace(config, data=DataConfig(masks="/b/masks"))
    train_field(scene, SmallNerf, moved, tmp_path, device, resume=True)
    hidden = [replace(view, mask=np.eye(EDGE, dtype=bool)) for view in scene.train]
    with pytest.raises(InputError, match="found other masks"):
        train_field(replace(scene, train=hidden), SmallNerf, moved, tmp_path, device, resume=True)


def test_another_device_resumes_with_a_warning(device, scene, tmp_path):
    config = replace(CONFIG, iterations=2)
    train_field(scene, SmallNerf, config, tmp_path, device)
    elsewhere = replace(Inputs.of(scene, device), device="another")
    with pytest.warns(UserWarning, match="the run continues on another"):
        load_checkpoint(tmp_path / CHECKPOINT, SmallNerf, config, elsewhere, device)


@pytest.mark.parametrize(("name", "value"), [("inputs", {}), ("inputs", 3), ("seconds", "x"), ("losses", [None])])
def test_damaged_facts_of_a_checkpoint_are_refused(device, scene, tmp_path, name, value):
    path, config = tmp_path / CHECKPOINT, replace(CONFIG, iterations=2)
    train_field(scene, SmallNerf, config, tmp_path, device)
    arrays = dict(np.load(path))
    about = json.loads(str(arrays["about"])) | {name: value}
    np.savez(path, **arrays | {"about": np.array(json.dumps(about))})
    with pytest.raises(InputError, match=f"{CHECKPOINT}: expected a checkpoint of clsplat, found a damaged file"):
        load_checkpoint(path, SmallNerf, config, Inputs.of(scene, device), device)


def test_damaged_files_are_refused(device, tmp_path):
    path = tmp_path / MODEL
    with pytest.raises(InputError, match="found no file"):
        load_field(path, METHODS, device)
    path.write_bytes(b"PK\x03\x04 no archive")
    with pytest.raises(InputError, match="damaged"):
        load_field(path, METHODS, device)
    np.savez(path, about=json.dumps({"method": "nerd"}))
    with pytest.raises(InputError, match="expected a field of nerf, nerf-small, plenoxels"):
        load_field(path, METHODS, device)


@pytest.mark.parametrize("byte", [8, 10], ids=["encrypted", "compression"])
def test_archives_that_python_cannot_read_are_damaged(byte, device, scene, tmp_path):
    """Bits of the flags, and the method, in the first entry of the archive's directory."""
    path = tmp_path / MODEL
    save_field(path, SmallNerf(Space.of(scene.train), device, 0))
    archive = bytearray(path.read_bytes())
    archive[archive.index(b"PK\x01\x02") + byte] |= 0x41
    path.write_bytes(archive)
    with pytest.raises(InputError, match="damaged"):
        load_field(path, {SmallNerf.name: SmallNerf}, device)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("table", lambda a: a[:-1]),
        ("table", lambda a: a[:, :4]),
        ("cells", lambda a: np.array([512, 1, 1])),
        ("squares", lambda a: a[:-1]),
    ],
)
def test_a_grid_whose_arrays_do_not_fit_is_refused(device, scene, tmp_path, name, change):
    """Kernels would read beyond the end of the arrays."""
    path, config = tmp_path / CHECKPOINT, replace(CONFIG, iterations=1)
    inputs = Inputs.of(scene, device)
    save_checkpoint(path, SmallPlenoxels(Space.of(scene.train), device, 0), config, inputs, 0.0, [])
    arrays = dict(np.load(path))
    np.savez(path, **arrays | {name: change(arrays[name])})
    with pytest.raises(InputError, match="damaged"):
        load_checkpoint(path, SmallPlenoxels, config, inputs, device)
