"""The sky of a scene in blocks: each block draws it, none trains it, and the joined scene has it once."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_plan import CONFIG, unseen
from test_sky_start import ring, square

from clsplat.blocks.block import _start, needed_parts, result_of
from clsplat.blocks.jobs import read_job
from clsplat.blocks.parts import read_scene
from clsplat.blocks.plan import Plan
from clsplat.blocks.settings import REFINING_LENGTHS
from clsplat.blocks.whole import files_of, merge, plan_blocks, plan_refinement, run_here
from clsplat.config import TrainConfig
from clsplat.device import Device
from clsplat.formats import load_gaussians
from clsplat.scene import Scene
from clsplat.training.sky_start import beyond


def planned(scene: Scene, sky: bool, device: Device, out: Path) -> tuple[list[Path], Plan, TrainConfig]:
    init = replace(CONFIG.init, sky=sky, triangulate=False)
    config = replace(CONFIG, blocks=2, max_gaussians=16_000, init=init)
    jobs, plan = plan_blocks(scene, config, device, out, out, unseen, lambda text: None)
    assert plan
    return jobs, plan, config


def test_the_sky_is_of_no_block(device: Device, tmp_path: Path) -> None:
    scene = square(ring())
    jobs, plan, config = planned(scene, True, device, tmp_path)
    job = read_job(jobs[0])
    sky, ground = (read_scene(jobs[0].with_name(name), 1) for name in (job.sky, job.far))
    assert len(sky) > 500 and beyond(sky, scene).all() and not beyond(ground, scene).any()
    assert plan.total == config.max_gaussians and min(block.backdrop for block in plan.blocks) > len(sky)

    run_here(jobs, scene, device, unseen)
    for path in jobs:
        start = _start(path, read_job(path))
        drawn = beyond(start.gaussians, scene)
        assert 100 < drawn.sum() <= len(sky) and start.trains.any() and not start.trains[drawn].any()
        assert not beyond(load_gaussians(result_of(path))[0], scene).any()
    later = plan_refinement(jobs, plan.cut(1), REFINING_LENGTHS[0], scene, config, tmp_path)
    run_here(later, scene, device, unseen)
    assert {read_job(path).sky for path in later} == {job.sky}
    assert {scene for scene, _, _ in needed_parts(later[0], read_job(later[0]))} == {"scene", "sky"}

    assert merge(files_of(later), tmp_path / "scene.ply") == sum(
        len(load_gaussians(result_of(path))[0]) for path in later
    ) + len(sky)
    joined = load_gaussians(tmp_path / "scene.ply")[0]
    np.testing.assert_array_equal(joined.means[beyond(joined, scene)], sky.means)


@pytest.mark.parametrize("case", ["not wanted", "nothing else"])
def test_blocks_without_a_sky(device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: str) -> None:
    """A coarse scene that lies behind the sky as a whole is cut as any other."""
    scene = square(ring())
    if case == "nothing else":
        monkeypatch.setattr("clsplat.blocks.whole.beyond", lambda gaussians, _: np.ones(len(gaussians), bool))
    jobs, _, _ = planned(scene, case == "nothing else", device, tmp_path)
    assert read_job(jobs[0]).sky == "" and files_of(jobs) == [*map(result_of, jobs)]
    run_here(jobs, scene, device, unseen)
