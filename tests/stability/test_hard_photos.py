"""Photos that no scene explains, and photos that change or disappear: a usable scene or a sentence, nothing else."""

import json
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from hard_data import end, write
from PIL import Image

from clsplat.bench.stability.small import CONFIG, small_scene
from clsplat.bench.stability.wrong_data import held_out_psnr, moving_object, wrong_focal
from clsplat.commands import train as train_command
from clsplat.config import InitConfig
from clsplat.dataset import decoding
from clsplat.dataset.photos import read_photo
from clsplat.errors import InputError
from clsplat.evaluate import mean_metrics
from clsplat.renderer import Renderer
from clsplat.run_log import LOG
from clsplat.training import preparation
from clsplat.training.initialize import initialize
from clsplat.training.loop import train
from clsplat.training.outcome import failure

DECODE = """
import resource, sys
from pathlib import Path
from clsplat.dataset.photos import read_photo
print(*read_photo(Path(sys.argv[1]), (0, 0, 0), upright=True).shape[:2])
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""
"""Decodes a photo, and prints its size and the peak of the memory of a process that does nothing else, KiB."""


@pytest.fixture(scope="module")
def scene(device):
    return small_scene(device)


@pytest.fixture
def trained(capsys, device, tmp_path):
    """Write a scene, train on it with the command, and return how that ended."""

    def run(scene, *options, size="fixed"):
        return end(capsys, device, write(tmp_path / "data", scene), tmp_path / "out", *options, size=size)

    return run


def with_photos(scene, photo):
    """The scene with `photo(view, number)` as its training photos."""
    return replace(scene, train=[replace(view, image=photo(view, i)) for i, view in enumerate(scene.train)])


def cropped(view, width, height):
    """The middle of a photo."""
    x, y = (view.camera.width - width) // 2, (view.camera.height - height) // 2
    camera = replace(view.camera, cx=view.camera.cx - x, cy=view.camera.cy - y, width=width, height=height)
    return replace(view, camera=camera, image=view.image[y : y + height, x : x + width])


def enlarged(view, factor):
    c = view.camera
    size = c.width * factor, c.height * factor
    numbers = {name: getattr(c, name) * factor for name in ("fx", "fy", "cx", "cy")}
    image = np.asarray(Image.fromarray(view.image).resize(size))
    return replace(view, image=image, camera=replace(c, width=size[0], height=size[1], **numbers))


def test_photos_of_noise_fail_by_a_sentence(scene, trained):
    rng = np.random.default_rng(0)
    noise = with_photos(scene, lambda view, _: rng.integers(0, 256, view.image.shape, dtype=np.uint8))
    found = trained(noise, size="auto")
    assert "where a constant colour for each has" in found.sentence


@pytest.mark.parametrize("level", [0, 255], ids=["black", "white"])
def test_photos_of_one_colour_fail_by_a_sentence(scene, trained, level):
    found = trained(with_photos(scene, lambda view, _: np.full_like(view.image, level)), size="auto")
    assert found.sentence.startswith("training failed: each of its photos has a single colour")


def test_transparent_photos_of_one_colour_do_not_fail(scene, device):
    """A black object on a black background has a shape where it is transparent."""
    clear = np.zeros(scene.train[0].image.shape[:2], np.uint8)
    clear[:9] = 255
    shown = [replace(v, image=np.zeros_like(v.image), clear=clear) for v in scene.train]
    gaussians = initialize(scene, InitConfig(), seed=0)
    assert failure(gaussians, shown, Renderer(device)) is None
    assert "single colour" in failure(gaussians, [replace(v, clear=None) for v in shown], Renderer(device))


def test_one_photo_at_many_poses(scene, trained):
    found = trained(with_photos(scene, lambda *_: scene.train[0].image))
    assert found.gain > 3


@pytest.mark.parametrize("points", [True, False], ids=["points", "random start"])
def test_many_photos_at_one_pose(scene, trained, points):
    same = replace(scene, train=[replace(view, camera=scene.train[0].camera) for view in scene.train])
    same = same if points else replace(same, points=same.points[:0], colors=same.colors[:0])
    # In 40 iterations, rates that fall at the end learn too little of a random start.
    assert trained(same, "--init.random-points", 500, "--optim.rates-final", 1).gain > 0.3


def test_two_photos(scene, trained):
    found = trained(replace(scene, train=scene.train[:2]))
    assert found.gain > 3 and "few photos" in found.said


def test_one_photo_is_held_out_unless_told_otherwise(scene, capsys, device, tmp_path):
    data = write(tmp_path / "data", replace(scene, train=scene.train[:1]))
    found = end(capsys, device, data, tmp_path / "refused")
    assert found.error and "found only held-out ones (1); see test_every" in found.sentence
    assert end(capsys, device, data, tmp_path / "out", "--test-every", 0).gain > 3


def test_photos_of_many_sizes_and_cameras(scene, trained):
    views = [enlarged(v, 1 + i % 3) if i % 2 else cropped(v, 40 - i, 32 - i) for i, v in enumerate(scene.train)]
    assert trained(replace(scene, train=views)).gain > 3


@pytest.mark.parametrize("size", [(1, 30), (40, 1), (1, 1)])
def test_photos_of_one_pixel_or_one_row(scene, trained, size):
    found = trained(replace(scene, train=[cropped(view, *size) for view in scene.train]))
    if size == (1, 1):
        assert "single colour" in found.sentence
    else:
        assert found.gain > 3


def test_a_wrong_focal_length_costs_quality(scene, device, tmp_path):
    """Photos and cameras agree with each other so far that the training itself cannot tell."""
    config, wrong = replace(CONFIG, iterations=100), wrong_focal(scene)
    gaussians = train(wrong, config, tmp_path, device)
    assert failure(gaussians, wrong.train, Renderer(device)) is None
    found = mean_metrics(gaussians, scene.test, Renderer(device))["psnr"]
    # Measured: 15.3 dB, and 21.7 dB with the right one.
    assert 12 < found < held_out_psnr(scene, scene.test, device, config) - 4


def test_masks_remove_an_object_that_moves(scene, device):
    plain, masked = (held_out_psnr(moving_object(scene, masked=m), scene.test, device) for m in (False, True))
    # Measured: 28.5 dB, 28.8 dB with masks, 29.1 dB without the object.
    assert 25 < plain < masked - 0.1


@pytest.mark.parametrize("change", ["removed", "replaced"])
def test_photos_that_change_later_change_nothing(scene, capsys, device, tmp_path, monkeypatch, change):
    """All photos are in memory: neither the training nor the evaluation reads a file again."""
    data = write(tmp_path / "data", scene)
    expected = end(capsys, device, data, tmp_path / "expected").gaussians

    start = train_command.train_and_report

    def changed(*args, **options):
        files = {path: path.read_bytes() for path in data.iterdir()}
        for path in data.glob("*.png"):
            path.unlink()
            if change == "replaced":
                path.write_bytes(files[data / "train05.png"])
        try:
            return start(*args, **options)
        finally:
            for path, content in files.items():  # the check of the end reads them
                path.write_bytes(content)

    monkeypatch.setattr(train_command, "train_and_report", changed)
    found = end(capsys, device, data, tmp_path / "out")
    for name, array in found.gaussians.arrays().items():
        np.testing.assert_array_equal(array, getattr(expected, name), err_msg=name)
    assert (tmp_path / "out" / "eval" / "metrics.json").is_file()


@pytest.mark.parametrize("change", ["one removed", "all removed", "other size", "damaged"])
def test_photos_that_change_before_points_are_triangulated(scene, capsys, device, tmp_path, monkeypatch, change):
    """Triangulation reads the photos again, at their full size."""
    data = write(tmp_path / "data", replace(scene, points=scene.points[:0], colors=scene.colors[:0]))
    files = {path: path.read_bytes() for path in data.iterdir()}
    triangulate = preparation.with_points

    def changed(*args, **options):
        for path in sorted(data.glob("*.png"))[1 : None if change == "all removed" else 2]:
            path.unlink()
            if change == "other size":
                Image.new("RGB", (7, 30)).save(path)
            elif change == "damaged":
                path.write_bytes(b"no photo")
        if change == "all removed":
            (data / "train00.png").unlink()
        try:
            return triangulate(*args, **options)
        finally:
            for path, content in files.items():
                path.write_bytes(content)

    monkeypatch.setattr(preparation, "with_points", changed)
    found = end(capsys, device, data, tmp_path / "out", "--init.random-points", 200)
    if change == "one removed":
        assert not found.error
    else:
        expected = {"all removed": "cannot find any", "other size": "found 7x30", "damaged": "as an image"}
        assert found.error and expected[change] in found.sentence


@pytest.mark.parametrize("jump", [-1e6, 1e6], ids=["backwards", "forwards"])
def test_a_clock_that_jumps_changes_no_bits(scene, device, tmp_path, monkeypatch, jump):
    config = replace(CONFIG, iterations=60)
    expected = train(scene, config, tmp_path / "expected", device)
    calls, clock = 0, time.perf_counter

    def jumping():
        nonlocal calls
        calls += 1
        return clock() + (jump if calls > 40 else 0)

    monkeypatch.setattr(time, "perf_counter", jumping)
    monkeypatch.setattr(time, "time", jumping)
    found = train(scene, config, tmp_path / "out", device)
    monkeypatch.undo()
    assert calls > 40
    for name, array in found.arrays().items():
        np.testing.assert_array_equal(array, getattr(expected, name), err_msg=name)
    lines = [json.loads(line) for line in (tmp_path / "out" / LOG).read_text().splitlines()]
    seconds = [line["seconds"] for line in lines]
    assert np.isfinite(seconds).all() and min(seconds) >= 0 and seconds == sorted(seconds)


def test_a_photo_that_exceeds_the_machines_memory_is_refused(scene, trained, monkeypatch):
    """A file takes 3840 bytes while it is decoded, the photo as many; halved, a quarter. Several photos stream."""
    monkeypatch.setattr(decoding, "physical_memory", lambda: 5_000)
    found = trained(scene)
    assert found.error and "found one that takes 0.00 GB; --downscale 2" in found.sentence
    monkeypatch.setattr(decoding, "physical_memory", lambda: 3_000)
    assert trained(scene).sentence.endswith("use smaller photos")


def test_large_photos_that_exceed_the_devices_memory_are_refused(scene, trained):
    large = replace(scene, train=[enlarged(view, 40) for view in scene.train[:2]])
    found = trained(large, "--test-every", 0, "--memory-limit", "50MB")
    assert found.error and "at 1600x1280, found 50.0 MB" in found.sentence
    assert found.sentence.endswith("with all of them: --downscale 2")


def test_photos_of_more_pixels_than_are_decoded_are_refused(scene, trained, monkeypatch):
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 600)  # a photo has 1280, more than twice as many
    found = trained(scene)
    assert found.error and "more than 0 million pixels, the most that are decoded" in found.sentence


@pytest.mark.slow
def test_a_photo_of_16384_by_16384_is_refused_and_a_smaller_one_decoded_within_3_gb(tmp_path):
    """Of 13000x13000 the decoded pixels alone take 0.5 GB."""
    path = tmp_path / "large.png"
    Image.new("L", (16384, 16384)).save(path, compress_level=1)
    with pytest.raises(InputError, match="more than 179 million pixels"):
        read_photo(path, (0, 0, 0), upright=True)
    Image.new("RGB", (13000, 13000), (10, 20, 30)).save(path, compress_level=1)
    done = subprocess.run([sys.executable, "-c", DECODE, str(path)], capture_output=True, text=True, check=True)
    width, height, peak = map(int, done.stdout.split())
    print(f"peak memory: {peak / 2**20:.2f} GiB")
    assert (width, height) == (13000, 13000) and peak < 3 * 2**20
