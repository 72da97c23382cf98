"""The plan: the fewest blocks that fit, configurations of coarse run and blocks, and what cannot be planned."""

from dataclasses import replace

import numpy as np
import pytest
from small_plan import CONFIG
from small_run import known_scene

from clsplat.blocks.partition import EVERYWHERE, Block, Box
from clsplat.blocks.plan import RESERVE, WHOLE, make_plan
from clsplat.blocks.settings import (
    REFINING_LENGTHS,
    block_config,
    check_blocks,
    coarse_config,
    one_fits,
    refining_config,
)
from clsplat.camera import Camera
from clsplat.config import FewViewsConfig, TrainConfig
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.renderer import Renderer
from clsplat.scene import Scene
from clsplat.testing import synthetic_scene
from clsplat.training.autosize.rule import full_size, reach
from clsplat.training.memory import Footprint
from clsplat.training.preparation import check_memory

SIZE = 40_000


def limited(least: int, scene, config) -> Device:
    """A device that fits this number of Gaussians and the backdrop of a scene of 2000."""
    need = replace(Footprint.of(scene, config, Device()), backdrop=2000)
    return Device(memory_limit=need.total(least))


def test_auto_takes_the_fewest_blocks_that_fit() -> None:
    scene = known_scene()
    config = replace(CONFIG, blocks="auto", max_gaussians=SIZE)
    coarse = synthetic_scene(2000, seed=1)[0]
    device = limited(SIZE // 3, scene, config)
    assert not one_fits(scene, config, device)
    plan = make_plan(coarse, scene, config, Renderer(device))
    count = len(plan.blocks)
    assert plan.memory <= (1 - RESERVE) * device.memory_limit and plan.total == SIZE
    fewer = make_plan(coarse, scene, replace(config, blocks=count - 1), Renderer(device))
    assert fewer.memory > (1 - RESERVE) * device.memory_limit
    assert 3 <= count <= 12
    for training in range(3):
        assert sum(int(block.box.contains(coarse.means).sum()) for block in plan.cut(training)) == len(coarse)
        assert all((block.wide == block.box) == (training == len(REFINING_LENGTHS)) for block in plan.cut(training))
    text = plan.describe(config, scene, 1.0)
    assert len(plan.between) == count + 1
    second, third = REFINING_LENGTHS
    steps = round(40 * (count + second * (count + 1) + third * count))
    assert text.startswith(f"blocks: {count}, each with 8 to ") and " of 12 photos" in text
    assert f"about {SIZE} Gaussians in all, {steps} iterations, {round(steps / 60)} minutes" in text


def street(count: int) -> tuple[Gaussians, Scene]:
    """A row of Gaussians along x, five for each of the photos above it, which look down and overlap by half."""
    rng = np.random.default_rng(0)
    gaussians = synthetic_scene(5 * count, seed=1)[0]
    means = rng.uniform(0, [count, 1, 0.2], (5 * count, 3))
    gaussians = replace(gaussians, means=means, log_scales=np.full((5 * count, 3), -2.5))
    view = known_scene().train[0]
    views = [
        replace(view, name=str(k), camera=Camera.look_at((k + 0.5, 0.5, 1), (k + 0.5, 0.5, 0), (0, 1, 0), 20, 40, 32))
        for k in range(count)
    ]
    return gaussians.astype(np.float32), Scene(views, [], np.zeros((0, 3)), np.zeros((0, 3), np.uint8))


def test_a_scene_may_need_many_times_the_memory() -> None:
    """A block draws what its photos show, however long the street is."""
    config = replace(CONFIG, blocks="auto")
    need = Footprint.of(street(10)[1], config, Device())
    device = Device(memory_limit=round(1.1 * need.total(400)))
    found = {}
    for count in (50, 200):
        coarse, scene = street(count)
        plan = make_plan(coarse, scene, replace(config, max_gaussians=40 * count), Renderer(device))
        assert plan.memory <= device.memory_limit
        shown = [block.gaussians + block.backdrop for block in plan.blocks]
        found[count] = len(plan.blocks), sum(len(b.photos) for b in plan.blocks) / count, max(shown)
    assert found[200][0] <= 5 * found[50][0]
    assert found[200][1] <= 1.25 * found[50][1], "a photo belongs to as many blocks"
    assert found[200][2] < 5 * 200, "no block draws all of the coarse scene"


def test_blocks_that_do_not_fit_are_cut_by_their_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks at the ends have fewer surroundings. They become longer, so that fewer blocks are enough."""
    coarse, scene = street(60)
    config = replace(CONFIG, blocks="auto", max_gaussians=40 * 60)
    limit = round(Footprint.of(scene, config, Device()).total(600) / (1 - RESERVE))
    alike = make_plan(coarse, scene, config, Renderer(Device(memory_limit=limit)))
    monkeypatch.setattr("clsplat.blocks.plan.ROUNDS", 0)
    equal = make_plan(coarse, scene, config, Renderer(Device(memory_limit=limit)))
    assert 2 < len(alike.blocks) < len(equal.blocks)
    sizes = [int(block.box.contains(coarse.means).sum()) for block in alike.blocks]
    at_end = [bool(np.isinf([block.box.low[0], block.box.high[0]]).any()) for block in alike.blocks]
    assert sum(at_end) == 2
    assert min(np.array(sizes)[at_end]) > max(np.array(sizes)[~np.array(at_end)])


def test_photos_count_by_the_part_that_a_block_fills() -> None:
    coarse, scene = street(40)
    plan = make_plan(coarse, scene, replace(CONFIG, blocks=10, max_gaussians=1600), Renderer())
    photos, visits = np.array([(len(block.photos), block.visits) for block in plan.blocks]).T
    # A block is four photos long, and two more show half of its margin; but it has eight photos.
    assert (photos >= 8).all() and (visits > 3).all() and (visits <= photos / WHOLE).all() and visits.mean() < 6
    assert (visits > photos).any(), "a photo that a block fills counts as more than one"


def test_each_block_draws_the_sky() -> None:
    coarse, scene = street(40)
    config = replace(CONFIG, blocks=4, max_gaussians=None)
    without, under = (make_plan(coarse, scene, config, Renderer(), sky) for sky in (0, 100))
    assert [block.backdrop for block in under.blocks] == [block.backdrop + 100 for block in without.blocks]
    assert under.total == without.total + 100 and under.memory > without.memory


def test_points_need_not_fit_if_blocks_do() -> None:
    scene, config = known_scene(), replace(CONFIG, max_gaussians=None)
    need = Footprint.of(scene, config, Device())
    fitting = len(scene.points) // 2
    device = Device(memory_limit=need.total(fitting))
    with pytest.raises(InputError, match=r"^--memory-limit: expected at least"):
        check_memory(scene, config, device, lambda text: None)
    told: list[str] = []
    check_memory(scene, replace(config, blocks="auto"), device, told.append)
    assert f" for {fitting} Gaussians, if" in told[0]


def test_nothing_fits() -> None:
    scene = known_scene()
    config = replace(CONFIG, blocks="auto", max_gaussians=SIZE)
    with pytest.raises(InputError, match=r"^--memory-limit: expected one that a block fits, found 3\.0 MB, where"):
        make_plan(synthetic_scene(200)[0], scene, config, Renderer(Device(memory_limit=3_000_000)))


def test_too_many_blocks() -> None:
    scene = known_scene()
    with pytest.raises(
        InputError, match=r"^--blocks: expected at most 2, as the coarse scene has 40 Gaussians, found 3"
    ):
        make_plan(synthetic_scene(40)[0], scene, replace(CONFIG, blocks=3), Renderer())


@pytest.mark.parametrize("name", ["poses", "exposure", "filter_3d"])
def test_what_blocks_cannot_train_is_refused(name: str) -> None:
    with pytest.raises(InputError, match=f"^--{name.replace('_', '-')}: expected a training without --blocks"):
        check_blocks(replace(TrainConfig(), **{name: True}))


def test_one_block_is_known_before_the_coarse_run(device: Device) -> None:
    scene = known_scene()
    assert one_fits(scene, replace(CONFIG, blocks="auto"), device)
    assert not one_fits(scene, replace(CONFIG, blocks=2), device)
    assert not one_fits(scene, replace(CONFIG, blocks="auto", max_gaussians=None), device)
    assert one_fits(scene, CONFIG, device)


def test_the_size_of_a_block_is_not_searched() -> None:
    """It is the expected one, and at most what a search would let its photos and points grow to."""
    scene, config = known_scene(), replace(CONFIG, size="auto", max_gaussians=None)
    block = Block(EVERYWHERE, EVERYWHERE, EVERYWHERE, np.arange(3), 900, 0, 3.0)
    searched = full_size(scene, len(scene.points), config)
    assert 900 < searched < 9000
    for gaussians, expected in ((900, 900), (9000, round(searched))):
        settings = block_config(config, scene, block._replace(gaussians=gaussians))
        assert (settings.size, settings.max_gaussians) == ("fixed", expected)
    nowhere = block._replace(wide=Box((9, 9, 9), (10, 10, 10)), gaussians=9000)
    assert block_config(config, scene, nowhere).max_gaussians == round(reach(scene, config)), "one per pixel"
    without = replace(scene, points=np.zeros((0, 3)), colors=np.zeros((0, 3), np.uint8))
    assert block_config(config, without, block).max_gaussians == 900


def test_configurations(device: Device) -> None:
    scene = known_scene()
    config = replace(CONFIG, iterations=9000, max_gaussians=1000, few=FewViewsConfig(below=3))
    coarse = coarse_config(config, scene, device)
    assert (coarse.iterations, coarse.max_gaussians, coarse.coarse.factor) == (3000, 250, 2)
    lengths = {n: coarse_config(replace(config, iterations=n), scene, device).iterations for n in (60, 3000, 30_000)}
    assert lengths == {60: 60, 3000: 1500, 30_000: 10_000}
    block = Block(EVERYWHERE, EVERYWHERE, EVERYWHERE, np.arange(3), 300, 0, 3.0)
    settings = block_config(config, scene, block)
    # Three photos alone would train for 3000 iterations; a quarter of all photos' visits are 2250.
    assert (settings.iterations, settings.max_gaussians, settings.optim.sh_degree_every) == (3000, 300, 1)
    assert block_config(replace(config, iterations=24_000), scene, block).iterations == 6000
    assert block_config(replace(config, iterations=24_000), scene, block._replace(visits=2.0)).iterations == 4000
    assert block_config(replace(config, iterations=70), scene, block).iterations == 70
    assert block_config(replace(config, max_gaussians=None), scene, block).max_gaussians is None
    large = replace(scene.train[5], camera=replace(scene.train[5].camera, width=1200, height=1200))  # 2 times as long
    mixed = replace(scene, train=[*scene.train[:5], large, *scene.train[6:]])
    assert block_config(config, mixed, block).iterations == 3000, "no photo of the block is large"
    assert block_config(config, mixed, block._replace(photos=np.arange(3, 6))).iterations == 6000
    later = refining_config(config, scene, block, 280, 0.5)
    assert (later.iterations, later.max_gaussians, later.error.stop_fraction) == (1500, 280, 0)
    assert later.optim.sh0_lr == settings.optim.sh0_lr / 2 and later.optim.means_lr == settings.optim.means_lr / 10
    assert later.error.opacity_penalty == later.mcmc.opacity_penalty == later.mcmc.scale_penalty == 0
    assert settings.error.opacity_penalty > 0
