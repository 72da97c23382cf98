"""The readers of clsplat as functions of bytes, and what must be true of everything they read: for fuzzing."""

import io
import shutil
import sys
import threading
import tracemalloc
import warnings
import zipfile
from contextlib import suppress
from pathlib import Path

import numpy as np
from PIL import Image

import clsplat
from clsplat.bench.captures_report import details, summary
from clsplat.bench.quality_summary import failures, trainings
from clsplat.bench.results import read_records
from clsplat.commands.info import dataset_lines, run_lines, scene_lines
from clsplat.config import DataConfig, InitConfig, TrainConfig
from clsplat.dataset import load_scene
from clsplat.dataset.depth_maps import read_depth_map
from clsplat.dataset.photos import (
    is_plain,
    is_transparent,
    orientation,
    photo_sharpness,
    photo_size,
    read_mask,
    read_photo,
    write_upright_png,
)
from clsplat.dataset.sfm.summary import preview
from clsplat.errors import InputError
from clsplat.formats import FORMATS, READ_ONLY, load_gaussians
from clsplat.formats.quantisation import EXPANSION_FREE
from clsplat.run_log import log_file
from clsplat.training.checkpoint import load_state
from clsplat.training.initialize import initialize
from clsplat.training.presets import load_config

PACKAGE = str(Path(clsplat.__file__).parent)
"""Folder of the code whose lines are counted."""

CORPUS = Path(__file__).with_name("corpus")
"""A folder per reader with files to start from and, named found-*, those that once failed."""

CHECKPOINT_CONFIG = TrainConfig(iterations=100, exposure=True, poses=True, filter_3d=True)
"""Configuration of the checkpoints in the corpus: every part of the state is there."""

MEMORY_MAX = 3 * EXPANSION_FREE
"""Largest memory for reading a file of a few kB, bytes: the limit on decompressed data, and float copies of it."""

PHOTO_MEMORY_MAX = 8 * 2 * Image.MAX_IMAGE_PIXELS
"""The same for photos, bytes. A PNG of one colour takes a byte per thousand pixels, so that only the number of pixels
is bounded: Pillow refuses more than twice MAX_IMAGE_PIXELS. A pixel takes two copies of its colour, and a byte."""

PARTS_MAX = 4 * 2**20
"""Largest total size of the files that a case for a folder is unpacked to, bytes."""


PIXELS_MAX = 2**20
"""Pictures with more pixels are not decoded: they take time in proportion, and reach no other code."""


class Odd(Exception):
    """A reader took a file and returned something that cannot be."""


def expect(true, what):
    """Raise `Odd` unless a statement about what was read is true."""
    if not true:
        raise Odd(what)


def finite(**arrays):
    """Expect numbers that are finite."""
    for name, array in arrays.items():
        expect(np.isfinite(array).all(), f"{name} is not finite")


def read_gaussians(path):
    gaussians, mode, offset = load_gaussians(path)
    expect(len(gaussians.validate()) > 0 and mode in ("classic", "antialiased"), "no Gaussians, or no mode")
    finite(**gaussians.arrays(), offset=offset)
    scene_lines(path)


def read_image(path):
    size, turned = photo_size(path), orientation(path)
    expect(min(size) >= 1 and turned in range(1, 9), f"size {size}, orientation {turned}")
    is_plain(path), is_transparent(path)
    if size[0] * size[1] > PIXELS_MAX:
        return
    stored = read_photo(path, (0.0, 0.0, 0.0), upright=False)
    expect(stored.dtype == np.uint8 and stored.shape == (*size[::-1], 3), f"{stored.shape} of {size}")
    upright = read_photo(path, (1.0, 1.0, 1.0), upright=True)
    expect(upright.shape in (stored.shape, (*size, 3)), f"{upright.shape} of {size}")
    finite(sharpness=photo_sharpness(path))
    write_upright_png(path, path.with_name("upright.png"))
    again = read_photo(path.with_name("upright.png"), (0.0, 0.0, 0.0), upright=True)
    expect((again == read_photo(path, (0.0, 0.0, 0.0), upright=True)).all(), "the upright PNG has other pixels")


def read_a_mask(path):
    size = photo_size(path)
    if size[0] * size[1] > PIXELS_MAX:
        return
    mask = read_mask(path)
    expect(mask.dtype == bool and mask.shape == size[::-1], f"a mask of {mask.dtype}, {mask.shape}")


def read_a_depth_map(path):
    if path.suffix == ".png":
        size = photo_size(path)
        if size[0] * size[1] > PIXELS_MAX:
            return
    depths = read_depth_map(path)
    expect(depths.dtype == np.float32 and depths.ndim == 2, f"depths of {depths.dtype}, {depths.shape}")
    expect(np.isfinite(depths).any() and not np.isinf(depths).any(), "no depth, or an infinite one")


def read_dataset(path):
    # The two read different parts: a dataset that one of them refuses may reveal a flaw of the other.
    with suppress(InputError):
        dataset_lines(path)
    scene = load_scene(path, DataConfig(test_every=0))
    finite(points=scene.points, offset=scene.offset, extent=scene.extent)
    expect(len(scene.points) == len(scene.colors) and scene.colors.dtype == np.uint8, "points unlike their colours")
    for part in (scene.train, scene.test):
        expect(len({view.name for view in part}) == len(part), "two photos of one name")
    if len(scene.points):
        finite(**initialize(scene, InitConfig(), 0, None).arrays())
    for view in scene.train + scene.test:
        camera = view.camera
        finite(viewmat=camera.viewmat, near=np.float32(camera.near_depth))
        expect(np.float32(min(camera.fx, camera.fy)) > 0, "a focal length of 0 in single precision")
        expect(view.image.shape == (camera.height, camera.width, 3), "a photo unlike its camera")
        expect(view.mask is None or view.mask.shape == view.image.shape[:2], "a mask unlike its photo")


def read_recovered(path):
    dataset_lines(path)
    found = preview(path)
    if found is not None:
        found.summary(), found.warnings()
        finite(positions=found.model.positions, points=found.model.points, sharpness=found.sharpness)


def read_checkpoint(path):
    state = load_state(path, 1.0, CHECKPOINT_CONFIG)
    n = len(state.gaussians.validate())
    expect(n > 0 and state.iteration >= 0 and state.seconds >= 0, f"{n} Gaussians, iteration {state.iteration}")
    finite(seconds=state.seconds, intersections=state.intersections, losses=state.losses)
    search = state.search
    for rows in (state.rows, *([search.small_side.rows] if search and search.small_side else [])):
        for part in (rows.gaussians, rows.moments.first, rows.moments.second):
            finite(**part.arrays())
        for array in rows.strategy.statistics.values():
            expect(len(array) == len(rows.gaussians), "statistics of another number of Gaussians")
    if search:
        candidates = [*search.degrees, *(side for trial in search.trials for side in (trial.smaller, trial.larger))]
        for c in candidates:
            expect(all(type(x) is float for x in (c.quality, *c.views, c.cost)), f"candidate {c}")
            expect(type(c.n) is int and c.n >= 0 and type(c.iteration) is int, f"candidate {c}")
        finite(pace=search.pace)
        with np.errstate(all="ignore"):  # an infinite PSNR, of a photo that is black as its render is, has no margin
            expect(all(isinstance(trial.margin, float) for trial in search.trials), "no margin")
        expect(not search.validated or np.mean(search.validated, axis=0).ndim == 1, "validated")
        expect(type(search.most) is int and type(search.settled) is int, f"most {search.most!r}")
    for learned, values in ((state.exposures, (3, 4)), (state.poses, (4, 4))):
        if learned:
            v = len(learned.names)
            expect(set(learned.names) == set(state.inputs.train), "parameters of other photos")
            expect(learned.values.shape == (v, *values) and learned.steps.shape == (v,), "values of another shape")
            finite(values=learned.values)
            expect(learned.first.shape == learned.second.shape and (learned.steps >= 0).all(), "moments")
    if state.filter.pixels is not None:
        expect(state.filter.pixels.shape == (n,), "pixel sizes of other Gaussians")


def read_run(path):
    with suppress(InputError):
        run_lines(path)
    log_file(path / "log.jsonl", 10)


def read_results(path):
    records = read_records(path)
    trainings(records), failures(records), summary(records), details(records)


READERS = {
    **{suffix[1:].replace(".", "-"): (f"scene{suffix}", read_gaussians) for suffix in (*FORMATS, *READ_ONLY)},
    "streamed-sog": ("scene", read_gaussians),
    "photo": ("photo.png", read_image),
    "mask": ("mask.png", read_a_mask),
    "depth-png": ("depth.png", read_a_depth_map),
    "depth-npy": ("depth.npy", read_a_depth_map),
    "colmap-bin": ("data", read_dataset),
    "colmap-txt": ("data", read_dataset),
    "transforms": ("data", read_dataset),
    "recovered": ("data", read_recovered),
    "checkpoint": ("checkpoint.npz", read_checkpoint),
    "run": ("run", read_run),
    "config-json": ("config.json", load_config),
    "config-yaml": ("config.yaml", load_config),
    "results": ("results.jsonl", read_results),
}
"""By name: the name of the file or folder that is read, and the function that reads and checks it. A folder is a ZIP
of its files in the corpus."""


def placed(folder, reader, content):
    """Write a case where its reader finds it; None if it is no ZIP of the files of a folder."""
    name, _ = READERS[reader]
    path = folder / name
    if Path(name).suffix:
        path.write_bytes(content)
        return path
    shutil.rmtree(path, ignore_errors=True)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if sum(info.file_size for info in archive.infolist()) > PARTS_MAX:
                return None
            path.mkdir(parents=True)
            archive.extractall(path)
    except Exception:  # the wrapping is the test's own: damage to it says nothing
        return None
    return path


def attempt(folder, reader, content, measured=True):
    """Read a case, and measure its memory, which takes three times as long.

    Returns
    -------
    str
        "read", "refused" by an InputError that names the file, or "none" for a folder that cannot be unpacked.

    Raises
    ------
    Exception
        Whatever else happens: the finding.
    """
    path = placed(folder, reader, content)
    if path is None:
        return "none"
    if measured:
        tracemalloc.start()
    try:
        with warnings.catch_warnings():
            # Warnings for the user are no finding, and neither are Pillow's on large images. NumPy's would reveal
            # unchecked values.
            warnings.simplefilter("error", RuntimeWarning)
            warnings.simplefilter("ignore", UserWarning)
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            try:
                READERS[reader][1](path)
                result = "read"
            except InputError as error:
                # A record of a bench holds the text of a command's argument, which such errors name.
                named = (
                    reader == "results"
                    or path.name in str(error)
                    or "photo" in str(error)
                    or "camera model" in str(error)
                )
                expect(named, f"the message does not name the file: {error}")
                result = "refused"
        _, peak = tracemalloc.get_traced_memory()  # 0 if it is not measured
        most = PHOTO_MEMORY_MAX if reader in ("photo", "mask", "depth-png") else MEMORY_MAX
        expect(peak < most, "memory out of proportion to the file")
        return result
    finally:
        tracemalloc.stop()


def key_of(error):
    """What tells findings apart: kind of the error, and the innermost function of clsplat that it passed."""
    place, frame = "", error.__traceback__
    while frame:
        code = frame.tb_frame.f_code
        if code.co_filename.startswith(PACKAGE):
            place = f"{Path(code.co_filename).name}:{code.co_name}"
        frame = frame.tb_next
    what = f" {str(error)[:60]}" if isinstance(error, Odd) else ""
    return f"{type(error).__name__}{what} in {place or 'the check'}"


def covered_lines(work):
    """Lines of clsplat that run while `work()` does, as (file, line)."""
    lines = set()

    def trace(frame, event, _):
        if not frame.f_code.co_filename.startswith(PACKAGE):
            return None
        if event == "line":
            lines.add((frame.f_code.co_filename, frame.f_lineno))
        return trace

    threading.settrace(trace), sys.settrace(trace)
    try:
        work()
    finally:
        sys.settrace(None), threading.settrace(None)
    return lines
