"""One iteration of algorithm 1 (Kerbl et al. 2023)."""

from typing import TYPE_CHECKING

from clsplat.randomness import stream
from clsplat.scene import View
from clsplat.stages import Dropout
from clsplat.training.corrections import compare, example, learn_pose
from clsplat.training.optimizer import adam_settings

if TYPE_CHECKING:
    from clsplat.training.loop import Training


def view_at(iteration: int, views: list[View], seed: int) -> View:
    """The view of an iteration, counted from 1: every epoch takes all views in an order of its own."""
    epoch, position = divmod(iteration - 1, len(views))
    return views[stream(seed, "order of the views", epoch).permutation(len(views))[position]]


def step(training: "Training", view: View) -> float:
    """Take one step: render a view, compare it with its photo, differentiate, update. Returns the loss."""
    state, config, renderer, optimizer = training.state, training.config, training.renderer, training.optimizer
    iteration = state.iteration + 1
    progress = (iteration - 1) / max(config.iterations - 1, 1)
    sh_degree = state.sh_degree(iteration, config)
    dropout = Dropout(config.dropout * progress, config.seed, iteration) if config.dropout else None
    seen = example(view, iteration, state, training.photos, config, renderer)

    gaussians = state.shown(renderer)
    run = renderer.forward(gaussians, seen.camera, sh_degree, background=seen.background, dropout=dropout)
    loss, v_image = compare(run.image, seen, progress, state, config, renderer)
    v_splats = renderer.backward_to_splats(run, v_image)

    strategy, size = state.strategy, (seen.camera.width, seen.camera.height)
    if strategy.watches(iteration):
        statistics = optimizer.bring(run.splats.extents), optimizer.bring(v_splats.means2d)
        strategy.observe(optimizer.stages, *statistics, *size)
    penalties = (*strategy.penalties(len(gaussians)), config.optim.erank_penalty / len(gaussians))
    settings = adam_settings(iteration, progress, state.extent, config.optim, sh_degree, penalties)
    v_camera = optimizer.step(
        state.gaussians, state.moments, state.filter, run, v_splats, settings, camera_grad=state.poses is not None
    )
    learn_pose(seen, v_camera, progress, state, config)
    strategy.perturb(optimizer.stages, state.gaussians, iteration, settings.rates["means"])
    state.intersections = max(state.intersections, run.bins.gauss_ids.shape[0] / len(gaussians))
    state.iteration = iteration
    return loss
