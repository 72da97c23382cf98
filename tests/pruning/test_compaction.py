"""Compacting a scene: limits hold, the loss is what rendering shows, views of nothing do not count."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from cli_runs import fails, run, write_dataset

from clsplat.camera import Camera
from clsplat.config import DataConfig
from clsplat.dataset import load_scene
from clsplat.errors import InputError
from clsplat.formats import FORMATS, load_gaussians, save_gaussians
from clsplat.gaussians import Gaussians
from clsplat.metrics import psnr, to_uint8
from clsplat.pruning import compaction, viewpoints
from clsplat.pruning.compaction import ASSUMED_PSNR, Limits, LossMeter, _Goal, _Search, choices_of
from clsplat.pruning.prices import price
from clsplat.pruning.reductions import Reduction
from clsplat.pruning.viewpoints import automatic_cameras, own_views
from clsplat.render import render
from clsplat.renderer import Renderer
from clsplat.testing import synthetic_scene


@pytest.fixture(scope="module")
def bloated(tmp_path_factory):
    """A dataset, and a scene with the 40 Gaussians that made its photos among 160 that do not show."""
    folder = tmp_path_factory.mktemp("data")
    truth = write_dataset(folder / "photos", 12).astype(np.float32)
    more = Gaussians.concatenate([truth] * 4)
    more.logit_opacities[:] = -6.5
    both = Gaussians.concatenate([more, truth])
    save_gaussians(folder / "bloated.ply", both)
    return folder


def test_loss_against_own_renders_in_numbers(device):
    """A difference as large as the assumed error doubles it: 3 dB."""
    gaussians, camera = synthetic_scene(20, 1)
    view = own_views(gaussians, {"a": camera}, Renderer(device))[0]
    loss = LossMeter(gaussians, [view], False, Renderer(device))
    assert loss(gaussians) == 0
    less = gaussians.take(np.arange(17))
    mse = 10 ** (-psnr(to_uint8(render(less, camera, device=device).rgb), view.image) / 10)
    assert loss(less) == pytest.approx(10 * np.log10(1 + mse / 10 ** (-ASSUMED_PSNR / 10)))


def test_loss_against_photos_is_the_difference_of_psnr(device, bloated):
    views = load_scene(bloated / "photos", DataConfig()).train
    truth = load_gaussians(bloated / "bloated.ply")[0]
    good, bad = truth.take(np.arange(40, 195)), truth.take(np.arange(180, 195))

    def mean_psnr(gaussians):
        return np.mean([psnr(to_uint8(render(gaussians, v.camera, device=device).rgb), v.image) for v in views])

    loss = LossMeter(good, views, True, Renderer(device))
    assert loss(bad) == pytest.approx(mean_psnr(good) - mean_psnr(bad), abs=0.1)  # but for the rounding of the photos
    assert loss(bad) > 1


@pytest.mark.parametrize(
    ("limits", "enough", "more"),
    [
        (Limits(gaussians=20), 20, 21),
        (Limits(bytes=300), 30, 31),  # a tenth of the file for each tenth of the Gaussians
        (Limits(gaussians=20, bytes=300), 20, 21),
        (Limits(loss=0.705, gaussians=1), 29, 30),
    ],
)
def test_the_reduction_goes_as_far_as_the_limits(limits, enough, more):
    """Of 100 Gaussians in 1000 bytes, each of which loses 0.01 dB."""
    scene = synthetic_scene(100)[0]
    goal = _Goal(scene, lambda left: 0.01 * (100 - len(left)), limits, lambda version: (version, 1000))
    assert goal.far_enough(scene.take(np.arange(enough)))
    assert not goal.far_enough(scene.take(np.arange(more)))


def test_a_loss_just_above_the_limit_does_not_end_the_search():
    """1000 Gaussians, of which 500 lose 0.46 dB and 550 lose 0.3 dB, in a format (float32) that adds 0.040026 dB."""
    scene = synthetic_scene(1000)[0]

    def loss(version):
        own = 0.0 if len(version) == 1000 else 0.3 if len(version) >= 550 else 0.46 if len(version) >= 500 else 0.9
        return own + 0.040026 * (version.means.dtype == np.float32)

    goal = _Goal(scene, loss, Limits(loss=0.5), lambda version: (version.astype(np.float32), len(version)))
    reduction = Reduction(scene, np.zeros((0, 2), np.intp), np.zeros(1000, np.intp), np.arange(1, 1001))
    search = _Search(goal, reduction, [scene])
    found = search.smallest(0.5)
    assert 550 <= len(found.gaussians) <= 1.02 * 550 and found.loss == pytest.approx(0.340026)


def test_the_whole_scene_is_the_last_resort():
    """If all other versions lose more than the limit, by rounding too."""
    scene = synthetic_scene(100)[0]

    def loss(version):
        rounded = version.means.dtype == np.float32
        return 0.09 if len(version) == 100 and rounded else 0.01 * (100 - len(version)) + 0.2 * rounded

    goal = _Goal(scene, loss, Limits(loss=0.1), lambda version: (version.astype(np.float32), len(version)))
    reduction = Reduction(scene, np.zeros((0, 2), np.intp), np.zeros(100, np.intp), np.arange(1, 101))
    search = _Search(goal, reduction, [scene])
    assert len(search.smallest(0.1).gaussians) == 100
    with pytest.raises(InputError, match=r"expected more than the 0\.090 dB that the format costs"):
        search.smallest(0.05)


def test_a_choice_that_needs_more_gaussians_than_the_limit_is_none():
    """The cheaper harmonics need 800 Gaussians, the others 500."""
    cheap, full = synthetic_scene(1000, sh_degree=0)[0], synthetic_scene(1000, sh_degree=3)[0]

    def search_within(most):
        def loss(version):
            return 0.0 if len(version) >= (800 if version.sh_degree == 0 else 500) else 1.0

        stored = lambda version: (version, len(version) * (100 + version.sh_degree))  # noqa: E731
        goal = _Goal(full, loss, Limits(gaussians=most, loss=0.5), stored)
        reduction = Reduction(full, np.zeros((0, 2), np.intp), np.zeros(1000, np.intp), np.arange(1, 1001))
        return _Search(goal, reduction, [cheap, full])

    assert 500 <= len(search_within(600).smallest(0.5).gaussians) <= 1.02 * 500
    with pytest.raises(InputError, match=r"^--max-gaussians: expected at least 50[0-9], which --max-psnr-loss 0.5"):
        search_within(400).smallest(0.5)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_prices_without_cameras_do_not_depend_on_the_unit(device, scale):
    """The near plane of automatic cameras follows the size of the scene, also where they price."""

    def priced(factor):
        scene = synthetic_scene(60)[0].astype(np.float32)
        scene.means *= factor
        scene.log_scales += np.float32(np.log(factor))
        renderer = Renderer(device)
        views = own_views(scene, automatic_cameras(scene, renderer), renderer)
        return price(scene, views, renderer).weights

    expected = priced(1)
    assert (expected > 0).sum() > 50
    np.testing.assert_allclose(priced(scale), expected, rtol=0.02, atol=1e-6)


def test_what_has_merged_has_the_curvature_of_both(monkeypatch):
    scene = synthetic_scene(3, sh_degree=1)[0]
    own, seen = np.float32([[1, 2], [10, 20], [100, 200]]), []
    monkeypatch.setattr(compaction, "curvatures", lambda *_: own)
    monkeypatch.setattr(compaction, "fitted_degree", lambda *_: None)
    monkeypatch.setattr(compaction, "with_shared_bands", lambda pool, curvature, size: seen.append(curvature))
    pool = Gaussians.concatenate([scene, scene.take(np.arange(2))])
    reduction = Reduction(pool, np.array([[0, 1], [3, 2]]), np.zeros(5), np.ones(5))
    choices_of(scene, reduction, [], 1, True, None)
    np.testing.assert_array_equal(seen[0], [*own, [11, 22], [111, 222]])


def compacted(bloated, out, *arguments, flag="--photos"):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*beyond what the format can hold|.*the format has no place")
        run("compact", bloated / "bloated.ply", "-o", out, flag, bloated / "photos", *arguments)
    return load_gaussians(out)[0]


def test_number_of_gaussians(bloated, tmp_path, capsys):
    found = compacted(bloated, tmp_path / "a.ply", "--max-gaussians", 40)
    before = load_gaussians(bloated / "bloated.ply")[0]
    assert len(found) == 40 and found.sh_degree == before.sh_degree
    assert (found.logit_opacities > 1).mean() > 0.9, "those that make the picture are kept"
    said = capsys.readouterr().err
    assert "views: 10 to price the Gaussians, 2 to measure the loss" in said, "every view has one of the two tasks"
    assert "200 Gaussians of degree 3" in said and "40 Gaussians of degree 3" in said and "loss: " in said
    assert len(compacted(bloated, tmp_path / "b.ply", "--max-gaussians", 999)) == 200


def test_offset_of_the_world(bloated, tmp_path):
    """A file whose coordinates count from elsewhere is compared where its scene is, and stays there."""
    scene, offset = load_gaussians(bloated / "bloated.ply")[0], np.array([4.0, -2.0, 8.0])
    expected = compacted(bloated, tmp_path / "a.ply", "--max-gaussians", 40)
    scene.means -= offset.astype(np.float32)
    save_gaussians(tmp_path / "moved.ply", scene, offset=offset)
    run(
        *("compact", tmp_path / "moved.ply", "-o", tmp_path / "b.ply", "--max-gaussians", 40),
        *("--photos", bloated / "photos"),
    )
    found, _, kept = load_gaussians(tmp_path / "b.ply")
    np.testing.assert_allclose(found.means + kept, expected.means, atol=1e-5)


@pytest.mark.parametrize("suffix", FORMATS)
def test_bytes(bloated, tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    limit = 25000 if suffix == ".sog" else 16000
    found = compacted(bloated, path, "--max-bytes", f"{limit / 1e6}MB")
    assert 0.5 * limit < path.stat().st_size <= limit or len(found) == 200


def test_loss(bloated, tmp_path, capsys):
    """As small as the stated loss admits: less for more."""
    sizes = []
    for limit in (0.5, 4):
        found = compacted(bloated, tmp_path / "a.ply", "--max-psnr-loss", limit, flag="--cameras")
        loss = float(capsys.readouterr().err.split("loss: ")[1].split()[0])
        assert 0.3 * limit < loss <= limit
        sizes.append((len(found), (tmp_path / "a.ply").stat().st_size))
    assert sizes[0][0] <= 45 and sizes[1][1] < 0.9 * sizes[0][1]


def test_degree_that_nobody_sees_is_dropped(bloated, tmp_path):
    scene = load_gaussians(bloated / "bloated.ply")[0]
    scene.sh[:, 4:] = 0
    save_gaussians(bloated / "flat.ply", scene)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        run(
            "compact",
            bloated / "flat.ply",
            "-o",
            tmp_path / "a.ply",
            "--cameras",
            bloated / "photos",
            "--max-psnr-loss",
            0.1,
        )
    assert load_gaussians(tmp_path / "a.ply")[0].sh_degree <= 1


def test_without_cameras(bloated, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(viewpoints, "VIEW_SIZE", (64, 48))
    monkeypatch.setattr(viewpoints, "CANDIDATES", 5)
    run("compact", bloated / "bloated.ply", "-o", tmp_path / "a.ply", "--max-gaussians", 50)
    assert len(load_gaussians(tmp_path / "a.ply")[0]) == 50
    assert "assuming 30 dB of the scene against photos" in capsys.readouterr().err


def test_views_of_nothing_are_left_out(device):
    gaussians, camera = synthetic_scene(20, 1)
    away = Camera.look_at(camera.position, 2 * camera.position, (0, 1, 0), 40.0, 37, 29)
    views = own_views(gaussians, {"away": away, "here": camera}, Renderer(device))
    assert [view.name for view in views] == ["here"]
    gaussians.logit_opacities[:] = -20
    assert automatic_cameras(gaussians, Renderer(device)) == {}


def test_bad_input_is_a_sentence(bloated, tmp_path, capsys):
    scene, photos, out = bloated / "bloated.ply", bloated / "photos", tmp_path / "a.ply"

    def error(*arguments, scene=scene, out=out):
        return fails(capsys, "compact", scene, "-o", out, *arguments)

    assert "expected at least one of these limits, found none" in error()
    assert "--max-gaussians: expected an integer, 1 or more, found 0" in error("--max-gaussians", 0)
    assert "--max-psnr-loss: expected a finite number, above 0, found -1" in error("--max-psnr-loss", -1.0)
    assert "--max-bytes: expected a size such as" in error("--max-bytes", "20")
    one = ("--max-gaussians", 9)
    assert "expected one of them, found both" in error(*one, "--photos", photos, "--cameras", photos)
    assert "expected a file of Gaussians in a folder that exists" in error(*one, out=tmp_path / "no" / "a.ply")
    assert "expected a file of Gaussians in a folder that exists" in error(*one, out=tmp_path / "a.xyz")
    assert "--max-bytes: expected at least" in error("--max-bytes", "0.0001MB", "--photos", photos)
    both = ("--max-psnr-loss", 0.5, "--max-gaussians", 3)
    assert "--max-gaussians: expected at least" in error(*both, "--photos", photos)
    lossy = error("--max-psnr-loss", 0.001, "--photos", photos, out=tmp_path / "a.splat")
    assert "dB that the format costs without any pruning" in lossy
    assert not out.exists()


def test_cameras_of_another_scene_are_an_error(bloated, tmp_path, capsys):
    far = load_gaussians(bloated / "bloated.ply")[0]
    far.means[:, 1] -= 1000  # above all cameras
    save_gaussians(tmp_path / "far.ply", far)
    for flag in ("--cameras", "--photos"):
        arguments = (tmp_path / "far.ply", "-o", tmp_path / "a.ply", "--max-gaussians", 9, flag, bloated / "photos")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            sentence = fails(capsys, "compact", *arguments)
        assert "do the cameras belong to" in sentence and "found 0 and 0 of 12" in sentence


def test_photos_of_something_else_are_warned_of(bloated, tmp_path, capsys):
    other = load_gaussians(bloated / "bloated.ply")[0]
    other.sh[:, 0] = 3 - other.sh[:, 0]
    save_gaussians(Path(tmp_path / "other.ply"), other)
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        run(
            *("compact", tmp_path / "other.ply", "-o", tmp_path / "a.ply", "--max-gaussians", 9),
            *("--photos", bloated / "photos"),
        )
    assert "dB; do they show it?" in capsys.readouterr().err
