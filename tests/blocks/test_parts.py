"""Scenes in parts: a block reads the parts that its photos may show, and ends with the bytes of the whole scene."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_plan import Planned

from clsplat.blocks.block import result_of, train_block
from clsplat.blocks.jobs import read_job
from clsplat.blocks.parts import bounds_of, read_index, read_part, read_scene, write_index
from clsplat.blocks.sight import Bounds, seen
from clsplat.blocks.whole import merge
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.formats import load_gaussians, save_gaussians
from clsplat.gaussians import Gaussians
from clsplat.testing import synthetic_scene

ROWS = 16
"""Rows of a part."""


@pytest.fixture(autouse=True)
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("clsplat.blocks.parts.PART", ROWS)


def written(folder: Path) -> tuple[Path, Gaussians]:
    """A scene of two files of 50 Gaussians, and all of them."""
    parts = [synthetic_scene(50, seed=k)[0].astype(np.float32) for k in range(2)]
    files = [folder / f"{k}.ply" for k in range(2)]
    for file, part in zip(files, parts, strict=True):
        save_gaussians(file, part)
    return write_index(files), Gaussians.concatenate([load_gaussians(file)[0] for file in files])


def test_an_index_has_the_rows_of_its_files_within_their_bounds(tmp_path: Path) -> None:
    index, scene = written(tmp_path)
    parts = read_index(index)
    assert [part.rows for part in parts] == [16, 16, 16, 2] * 2
    for name, array in read_scene(index, 1).arrays().items():
        np.testing.assert_array_equal(array, getattr(scene, name))
    bounds = bounds_of(parts)
    for k, part in enumerate(parts):
        each = Bounds.of(read_part(tmp_path, part))
        assert (each.low >= bounds.low[k]).all() and (each.high <= bounds.high[k]).all()
        assert (each.radius <= bounds.radius[k]).all()


def test_a_part_alone_is_read_where_its_file_is_not(tmp_path: Path) -> None:
    index, scene = written(tmp_path)
    part = read_index(index)[5]
    rows = (tmp_path / part.file).read_bytes()[part.begin : part.begin + part.size]
    for file in tmp_path.glob("*.ply"):
        file.unlink()
    with pytest.raises(InputError, match=r"cannot read .*1\.ply"):
        read_part(tmp_path, part)
    (tmp_path / f"{part.digest}.rows").write_bytes(rows)
    np.testing.assert_array_equal(read_part(tmp_path, part).means, scene.means[66:82])


def test_a_second_training_reads_what_its_photos_show(
    planned: Planned, device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half of the scene is where no photo looks: its file need not even exist."""
    for job in planned.jobs:
        train_block(job, planned.scene.train, device)
    path = planned.again()[0]
    job, folder = read_job(path), path.parent
    visible = read_scene(folder / job.scene, 1)
    hidden = Gaussians(**{name: array.copy() for name, array in visible.arrays().items()})
    hidden.means[:] = [0, -300, 0]  # far above the cameras, which look down
    shared = np.isfinite(job.wide.high)
    hidden.means[:, shared] = np.asarray(job.wide.high)[shared] + 100
    assert not seen(job.posed(), Bounds.of(hidden), job.config.render).any()
    assert not job.wide.contains(hidden.means).any()
    save_gaussians(folder / "hidden.ply", hidden)
    both = write_index([folder / "hidden.ply", *map(result_of, planned.jobs)])

    second = replace(job, scene=both.name).write(folder)
    with monkeypatch.context() as everything:
        everything.setattr("clsplat.blocks.sight.may_see", lambda camera, bounds, config: bounds.radius > 0)
        expected = train_block(second, planned.scene.train, device).read_bytes()
    result_of(second).unlink()
    (folder / "hidden.ply").unlink()
    assert train_block(second, planned.scene.train, device).read_bytes() == expected
    assert train_block(path, planned.scene.train, device).read_bytes() == expected
    assert merge([result_of(path)], tmp_path / "scene.ply") > 40
