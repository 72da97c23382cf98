"""Sparse points of a block: where they are, how many, and that the block trains them."""

from dataclasses import replace

import numpy as np
from small_plan import Planned

from clsplat.blocks.block import points_of, result_of, train_block
from clsplat.blocks.jobs import read_job
from clsplat.blocks.parts import read_scene
from clsplat.blocks.points import sparse_start
from clsplat.device import Device


def test_a_block_starts_with_its_sparse_points(planned: Planned, device: Device) -> None:
    for path, block in zip(planned.jobs, planned.plan.blocks, strict=True):
        job = read_job(path)
        coarse, points = (read_scene(path.with_name(name), 1).means for name in (job.scene, job.points))
        assert block.wide.contains(points).all() and len(points) > 40
        assert len(points) + block.wide.contains(coarse).sum() <= block.gaussians
        assert {tuple(row) for row in points} <= {tuple(row) for row in np.float32(planned.scene.points)}

    path = planned.jobs[0]
    with_points = train_block(path, planned.scene.train, device).read_bytes()
    without = replace(read_job(path), points="").write(path.parent)
    assert train_block(without, planned.scene.train, device).read_bytes() != with_points
    assert not points_of(without, read_job(without))
    train_block(planned.jobs[1], planned.scene.train, device)
    assert all(read_job(second).points == "" for second in planned.again()), "they have been trained"
    assert result_of(path).exists()


def test_points_where_there_is_room_for_them(planned: Planned) -> None:
    scene, config, block = planned.scene, planned.config, planned.plan.blocks[0]
    means = scene.points[block.wide.contains(scene.points)][:30]
    some = sparse_start(scene, means, block._replace(gaussians=50), config)
    assert some and len(some) == 20
    more = sparse_start(scene, means, block._replace(gaussians=60), config)
    assert more and {tuple(row) for row in some.means} < {tuple(row) for row in more.means}
    assert sparse_start(scene, means, block._replace(gaussians=30), config) is None
    nothing = replace(scene, points=np.zeros((0, 3)), colors=np.zeros((0, 3), np.uint8))
    assert sparse_start(nothing, means, block, config) is None
