"""Training: algorithm 1 of Kerbl et al. 2023."""

import time
import warnings
from collections.abc import Callable, Container
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from clsplat.config import BACKGROUNDS, InitConfig, TrainConfig
from clsplat.constants import ALPHA_MIN
from clsplat.errors import ClsplatError, DeviceError, InputError, driver_errors
from clsplat.gaussians import Gaussians, logit
from clsplat.randomness import stream
from clsplat.render import backward_to_splats, download, fetch, forward, stage_functions
from clsplat.scene import Scene, View
from clsplat.stages import Dropout, Image
from clsplat.training import coarse_to_fine as pyramid
from clsplat.training import photo_exposures as exposure
from clsplat.training import photo_poses as poses
from clsplat.training.autosize import rule as size
from clsplat.training.autosize.explanation import write_report
from clsplat.training.autosize.search import seek_size
from clsplat.training.checkpoint import (
    State,
    as_seen,
    filtered,
    load_state,
    log_file,
    measure_pixels,
    move,
    on_device,
    save_state,
    write_photos,
)
from clsplat.training.contributions import contributions
from clsplat.training.densify import STRATEGIES, Contributions, Edit
from clsplat.training.initialize import initialize
from clsplat.training.memory import INTERSECTIONS, Footprint, Photos
from clsplat.training.optimizer import Moments, adam_settings, sh_degree_at

if TYPE_CHECKING:
    from clsplat.device import Device

# Iterations between two looks at what the cameras resolve (Mip-Splatting's code); also after every edit.
FILTER_EVERY = 100

# Iterations per line of the log: its loss is their mean, since the loss of single photos says little.
LOG_EVERY = 10


def view_at(iteration: int, views: list[View], seed: int) -> View:
    """The view trained on in an iteration, counted from 1: every epoch takes all views in an order of its own."""
    epoch, position = divmod(iteration - 1, len(views))
    return views[stream(seed, "order of the views", epoch).permutation(len(views))[position]]


def train(
    scene: Scene,
    config: TrainConfig,
    device: "Device",
    out: Path,
    *,
    resume: bool = False,
    evaluate: Callable[[Gaussians], dict[str, float]] | None = None,
    evaluate_after: Container[int] | None = None,
    progress: Callable[[dict[str, Any]], None] = lambda record: None,
) -> Gaussians:
    """Train Gaussians on a scene's photos.

    Parameters
    ----------
    scene : Scene
    config : TrainConfig
    device : Device
    out : Path
        Folder, made where it is missing, for checkpoint.npz, from which an interrupted run resumes, and log.jsonl,
        one JSON object per line.
    resume : bool
        Continue from the checkpoint in `out`, to the same bits as a run that was never interrupted.
    evaluate : callable, optional
        Called every `config.eval_every` iterations; what it returns is logged. Its time does not count.
    evaluate_after : container of int, optional
        The iterations after which `evaluate` is called, in the place of those.
    progress : callable
        Called after every iteration with iteration, loss, num_gaussians and gaussians, which are the ones that train:
        to be looked at only. Its time does not count. If it raises KeyboardInterrupt, a checkpoint is written before
        the run ends.

    Returns
    -------
    Gaussians
        In the scene's coordinates.

    Raises
    ------
    InputError
        If the scene has no photos to train on, the strategy is unknown, the price is negative, or the checkpoint is
        of another configuration.
    DeviceError
        If the device's memory, or its limit, is exceeded in spite of all.
    ClsplatError
        If the loss stops being finite.

    Warns
    -----
    UserWarning
        If the Gaussians stop growing because more would not fit the device's memory.
    """
    if config.strategy not in STRATEGIES:
        raise InputError(f"--strategy: expected one of {', '.join(STRATEGIES)}, found {config.strategy!r}")
    if not config.size_price >= 0:
        raise InputError(f"--size-price: expected 0 or more, found {config.size_price}")
    if not scene.train:
        raise InputError("scene: expected at least one photo to train on, found none; lower --test-every")
    state = load_state(out / "checkpoint.npz", scene.extent, config) if resume else initial_state(scene, config)
    if evaluate_after is None:
        evaluate_after = (
            range(config.eval_every, config.iterations + 1, config.eval_every) if config.eval_every else ()
        )
    photos, need = Photos(device), Footprint.of(scene, config, device)
    if config.optimizer == "device":
        move(state, device)
    if state.pixels is not None:
        state.pixels = device.upload("pixel sizes", state.pixels)
    losses: list[float] = []
    training, trained_on = scene.train, (1, False)  # the photos' size, and whether parts validate

    def tell(shown: State, loss: float) -> None:
        about = {"iteration": state.iteration, "loss": loss, "num_gaussians": len(shown.gaussians)}
        try:
            progress(about | {"gaussians": shown.gaussians if shown.pixels is None else filtered(shown, device)})
        except KeyboardInterrupt:
            save_state(out / "checkpoint.npz", state, config)
            raise

    with log_file(out / "log.jsonl", state.iteration) as log:
        started = time.perf_counter() - state.seconds
        for iteration in range(state.iteration + 1, config.iterations + 1):
            wanted = pyramid.factor_at(iteration, config), bool(state.search and not state.search.settled)
            if trained_on != wanted:
                trained_on = factor, seeking = wanted
                views = size.split(scene.train)[0] if seeking else scene.train
                training, photos = [pyramid.shrunk(view, factor) for view in views], Photos(device)
            intersections = state.intersections or INTERSECTIONS
            photos.keep_within(device.memory_limit - need.total(len(state.gaussians), intersections))
            go = partial(advance, views=training, photos=photos, need=need, config=config, device=device)
            try:
                with driver_errors():
                    state = seek_size(state, iteration, scene.train, config, device, go, tell)
                    loss = go(state, iteration)
            except DeviceError as error:
                raise DeviceError(
                    f"iteration {iteration}: {error}; the last checkpoint in {out}, if there is one, is intact: "
                    "--resume goes on from there, and a lower --memory-limit stops growth earlier"
                ) from error
            if not np.isfinite(loss):
                raise ClsplatError(
                    f"training diverged: the loss of iteration {iteration} is {loss}; lower the learning rates "
                    f"(--optim.*); the last checkpoint in {out} is intact"
                )
            losses.append(loss)
            state.seconds = time.perf_counter() - started
            record: dict[str, Any] = {}
            if iteration % LOG_EVERY == 0 or iteration == config.iterations:
                record = {"loss": float(np.mean(losses))}
                losses.clear()
            if evaluate and iteration in evaluate_after:
                record |= evaluate(fetch(filtered(state, device)))
                started = time.perf_counter() - state.seconds
            if record:
                at = {"iteration": iteration, "num_gaussians": len(state.gaussians), "seconds": state.seconds}
                log(at | record)
            if iteration % config.checkpoint_every == 0 or iteration == config.iterations:
                save_state(out / "checkpoint.npz", state, config)
            left = time.perf_counter()
            tell(state, loss)
            started += time.perf_counter() - left
    if state.exposures or state.poses:
        write_photos(out / "photos.json", state, scene)
    if not state.search:
        return fetch(filtered(state, device))
    write_report(out / "size.json", state.search, config)
    return size.without_useless_bands(fetch(filtered(state, device)), as_seen(scene.train, state), config, device)


def advance(
    state: State,
    iteration: int,
    views: list[View],
    photos: Photos,
    need: Footprint,
    config: TrainConfig,
    device: "Device",
) -> float:
    """One iteration and the edit that is due after it. Changes `state`, returns the loss."""
    if config.filter_3d and state.pixels is None:
        measure_pixels(state, views, device)
    loss = step(state, iteration, view_at(iteration, views, config.seed), photos, config, device)
    if state.strategy.due(iteration):
        set_cap(state, config, need.most_gaussians(device.memory_limit, state.intersections))
        densify(state, views, config, device)
    if config.filter_3d and (state.pixels is None or iteration % FILTER_EVERY == 0):
        measure_pixels(state, views, device)
    return loss


def set_cap(state: State, config: TrainConfig, fitting: int) -> None:
    """How many Gaussians the next edit may leave: what the user allows, what fits the device, what the search for the
    size says; where that needs more photos than there are, no more than there are Gaussians."""
    cap = min(config.max_gaussians or fitting, fitting)
    if config.size == "auto":
        cap = min(cap, state.search.most if state.search else len(state.gaussians))
    elif len(state.gaussians) >= fitting:
        warnings.warn(f"no more than {fitting} Gaussians fit the memory: growth stops", stacklevel=2)
    state.strategy.max_gaussians = cap


def step(state: State, iteration: int, view: View, photos: Photos, config: TrainConfig, device: "Device") -> float:
    """One iteration: render, compare, differentiate, update. Changes `state`, returns the loss."""
    camera = poses.refined(view.camera, state.poses.of(view.name)) if state.poses else view.camera
    sh_degree = sh_degree_at(iteration, config.shortened(config.optim.sh_degree_every), state.gaussians.sh_degree)
    photo, mask = photos(view)
    background = BACKGROUNDS[config.data.background]
    if config.data.random_background:
        drawn = tuple(stream(config.seed, "backgrounds", iteration).random(3).tolist())
        if view.clear is not None:
            photo = device.upload("photo", view.on(drawn, background), np.uint8)
        background = drawn
    optimizer = device if config.optimizer == "device" else None
    gaussians = filtered(state, device)

    progress = (iteration - 1) / max(config.iterations - 1, 1)
    dropout = Dropout(config.dropout * progress, config.seed, iteration) if config.dropout else None
    run = forward(device, gaussians, camera, config.render, background, sh_degree, dropout=dropout)
    state.intersections = max(state.intersections, run.bins.gauss_ids.shape[0] / len(gaussians))
    stage, image = stage_functions(device), run.image.image
    if state.exposures:
        affine = state.exposures.of(view.name)
        image = stage.exposure_fwd(image, affine, photo)
    loss, v_image = stage.l1_ssim(image, photo, config.optim.ssim_weight, mask)
    if state.exposures:
        v_affine = stage.exposure_bwd(run.image.image, affine, photo, v_image)
        exposure.update(state.exposures, view.name, v_affine, progress, config.optim)
    # No kernel writes this buffer: the loss does not depend on alpha.
    v_alpha = device.scratch("v_alpha", camera.height * camera.width)
    v_splats = backward_to_splats(device, run, Image(v_image, v_alpha))

    if state.strategy.watches(iteration):
        extents, v_means2d = run.splats.extents, v_splats.means2d
        if not optimizer:
            extents, v_means2d = download(extents), download(v_means2d)
        state.strategy.observe(stage_functions(optimizer), extents, v_means2d, camera.width, camera.height)
    settings = adam_settings(iteration, progress, state.extent, config.optim, sh_degree)
    erank = config.optim.erank_penalty / len(gaussians)
    settings = settings._replace(penalties=(*state.strategy.penalties(len(gaussians)), erank))
    moments = state.moments.first, state.moments.second
    options = {"antialiased": config.render.mode == "antialiased", "camera_grad": state.poses is not None}
    if optimizer and state.pixels is None:
        v_camera = stage.project_bwd_adam(gaussians, moments, camera, run.splats, v_splats, settings, **options)
    else:
        v_gaussians, v_camera = stage.project_bwd(gaussians, camera, sh_degree, run.splats, v_splats, **options)
        if state.pixels is not None:
            v_gaussians = stage.filter_bwd(on_device(state.gaussians, device), state.pixels, v_gaussians)
        v_gaussians = v_gaussians if optimizer else fetch(v_gaussians)
        stage_functions(optimizer).adam_step(state.gaussians, v_gaussians, *moments, settings)
    if state.poses:
        rate = poses.rate_at(progress, config.optim)
        poses.update(state.poses, view.name, camera, v_camera.viewmat, rate, state.extent, config.optim)
    state.strategy.perturb(stage_functions(optimizer), state.gaussians, iteration, settings.rates["means"])
    state.iteration = iteration
    return loss


def densify(state: State, views: list[View], config: TrainConfig, device: "Device") -> None:
    """The edit that is due after an iteration. Changes `state`.

    Not a part of `step`, whose arrays of the old size must be gone before those of the new one are allocated.
    """
    _apply(_edit(state, views, config, device), state)
    if config.optimizer == "device":
        move(state, device)


def _edit(state: State, views: list[View], config: TrainConfig, device: "Device") -> Edit:
    gaussians = shown = state.gaussians
    if state.pixels is not None:
        shown = fetch(filtered(state, device))
    sh_degree = sh_degree_at(state.iteration, config.shortened(config.optim.sh_degree_every), gaussians.sh_degree)

    def survey(count: int) -> Contributions:
        order = stream(config.seed, "surveyed views", state.iteration).permutation(len(views))
        chosen = as_seen([views[i] for i in order[:count]], state)
        found = contributions(device, shown, chosen, config.render, BACKGROUNDS[config.data.background], sh_degree)
        return found._replace(share=len(chosen) / len(views))

    move(state, None)
    edit = state.strategy.edit(state.iteration, state.gaussians, survey)
    if edit.reset_opacities and state.pixels is not None:
        # What is shown is lowered to the value of the reset: less, and it might be invisible for good.
        before = state.gaussians.opacities[edit.rows]
        raised = edit.gaussians.opacities * before / np.maximum(shown.opacities[edit.rows], ALPHA_MIN)
        most = np.minimum(before, 1 - 1e-6)  # whose logit is finite
        edit.gaussians.logit_opacities[:] = logit(np.clip(raised, edit.gaussians.opacities, most))
    return edit


def _apply(edit: Edit, state: State) -> None:
    state.gaussians, state.moments = edit.gaussians, state.moments.take(edit.rows, edit.fresh)
    state.pixels = None  # of other rows
    if edit.reset_opacities:
        state.moments.first.logit_opacities[:] = 0
        state.moments.second.logit_opacities[:] = 0


def initial_state(scene: Scene, config: TrainConfig) -> State:
    """The state before the first iteration."""
    gaussians = initialize(scene, start_config(config), config.seed, config.max_gaussians)
    strategy = STRATEGIES[config.strategy](config, scene.extent, len(gaussians))
    search = size.Search(len(gaussians)) if config.size == "auto" and size.can_search(scene.train) else None
    state = State(0, 0.0, scene.extent, gaussians, Moments.zeros(gaussians), strategy, search=search)
    names = [view.name for view in scene.train]
    state.exposures = exposure.start(names) if config.exposure else None
    state.poses = poses.start(names) if config.poses else None
    return state


def start_config(config: TrainConfig) -> InitConfig:
    """What the first Gaussians are like, where the configuration leaves it to strategy and search."""
    init = config.init
    if init.opacity is None:
        init = replace(init, opacity=STRATEGIES[config.strategy].start_opacity)
    if init.random_points is None and config.size == "auto":
        init = replace(init, random_points=size.RANDOM_START)
    return init
