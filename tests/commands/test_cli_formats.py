"""Files of Gaussians on the command line: axes and versions of .spz, formats with one side, folders of scenes."""

from dataclasses import replace

import numpy as np
import pytest
from bounds import BOUNDS, matched, random_gaussians
from foreign_code import SCRIPTS
from scipy.spatial.transform import Rotation

from clsplat.camera import Camera
from clsplat.cli import main
from clsplat.formats import load_gaussians, save_gaussians
from clsplat.pruning.levels import halved
from clsplat.pruning.merging import covariances
from clsplat.render import render


def run(*arguments):
    main([str(argument) for argument in arguments])


@pytest.fixture
def scene(tmp_path):
    save_gaussians(tmp_path / "scene.ply", random_gaussians(50, 1))
    return tmp_path / "scene.ply"


def worst(found, expected):
    return np.abs(matched(found, expected).means - expected.means).max()


def test_spz_axes_of_the_file_that_is_written(scene, tmp_path, capsys):
    source, step = load_gaussians(scene)[0], BOUNDS[".spz"](load_gaussians(scene)[0])[0]
    run("export", scene, tmp_path / "a.spz", "--spz-axes", "rdf")
    found = load_gaussians(tmp_path / "a.spz")[0]  # not recorded in version 3: read as specified, half a turn away
    found.means *= np.float32([1, -1, -1])
    assert worst(found, source) <= step * 1.001
    run("export", tmp_path / "a.spz", tmp_path / "again.ply", "--spz-axes", "rdf")
    assert worst(load_gaussians(tmp_path / "again.ply")[0], source) <= step * 1.001
    run("export", scene, tmp_path / "b.spz", "--spz-axes", "rdf", "--spz-version", 4)
    assert (tmp_path / "b.spz").read_bytes()[:4] == b"NGSP"
    assert worst(load_gaussians(tmp_path / "b.spz")[0], source) <= step * 1.001
    run("info", tmp_path / "b.spz")
    assert "axes recorded as right, down, forward" in capsys.readouterr().out


def test_spz_axes_without_an_spz(scene, tmp_path, capsys):
    with pytest.raises(SystemExit):
        run("export", scene, tmp_path / "a.sog", "--spz-axes", "rdf")
    assert "--spz-axes: expected an .spz to read or to write" in capsys.readouterr().err


def test_a_file_of_splat_transform_is_turned_upright(tmp_path):
    run("export", SCRIPTS / "st.spz", tmp_path / "a.ply", "--spz-axes", "rdf")
    assert worst(load_gaussians(tmp_path / "a.ply")[0], load_gaussians(SCRIPTS / "source.ply")[0]) < 1 / 4096


@pytest.mark.parametrize("suffix", [".usda", ".csv"])
def test_formats_that_are_only_written(scene, tmp_path, capsys, suffix):
    run("export", scene, tmp_path / f"a{suffix}")
    assert (tmp_path / f"a{suffix}").stat().st_size > 1000
    with pytest.raises(SystemExit):
        run("info", tmp_path / f"a{suffix}")
    assert "which it only writes" in capsys.readouterr().err


def test_formats_that_are_only_read(scene, tmp_path, capsys):
    run("info", SCRIPTS / "mkkellogg-1.ksplat")
    assert ".ksplat (mkkellogg), compression level 1" in capsys.readouterr().out
    for command in (["export", scene], ["train", tmp_path], ["compact", scene, "--max-gaussians", 9]):
        with pytest.raises(SystemExit):
            run(*command, "-o", tmp_path / "a.ksplat")
        assert "a.ksplat: expected a" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [scene]


def test_a_folder_of_streamed_scenes_is_a_scene(tmp_path, capsys):
    run("info", SCRIPTS / "streamed")
    assert "streamed SOG (PlayCanvas), 2 levels of detail" in capsys.readouterr().out
    run("export", SCRIPTS / "streamed", tmp_path / "a.glb")
    assert len(load_gaussians(tmp_path / "a.glb")[0]) == 40


def test_levels_of_a_run_are_refined_against_its_photos(trained, dataset, tmp_path, capsys):
    run("export", trained, tmp_path / "levels")
    said = capsys.readouterr()
    assert "level 1: " in said.out + said.err and "held-out PSNR at half size" in said.out + said.err
    run("export", trained / "scene.ply", tmp_path / "merged")
    said = capsys.readouterr()
    assert "level 1: " not in said.out + said.err, "a file knows no photos"
    found, merged = (load_gaussians(tmp_path / name)[0] for name in ("levels", "merged"))
    assert len(found) == len(merged), "the finest level is the scene"


def test_a_scene_in_another_place_has_the_same_image(scene, tmp_path, capsys):
    """From a camera that has moved with it; with a shear or an untouched harmonic the images would differ."""
    run("export", scene, tmp_path / "b.ply", "--scale", 2.5, "--rotate", 20, -30, 50, "--move", 3, -1, 0.5)
    camera = Camera.look_at([0.3, -0.5, -9], [0, 0, 0], [0, -1, 0], 60, 64, 48)
    turn = Rotation.from_euler("xyz", (20, -30, 50), degrees=True).as_matrix()
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = turn.T, -turn.T @ [3, -1, 0.5]  # back to the first place, still scaled
    viewmat = camera.viewmat.copy()
    viewmat[:3, 3] *= 2.5
    before, after = (load_gaussians(tmp_path / name)[0] for name in ("scene.ply", "b.ply"))
    seen = render(before, camera, device="reference").rgb
    moved = render(after, replace(camera, viewmat=viewmat @ motion), device="reference").rgb
    assert seen.std() > 0.05
    np.testing.assert_allclose(moved, seen, atol=2e-4)  # the file's coordinates are in single precision


def test_the_offset_of_a_scene_is_turned_and_scaled(tmp_path):
    gaussians = random_gaussians(50, 1)
    save_gaussians(tmp_path / "far.ply", gaussians, offset=np.array([1000.0, 0.0, 0.0]))
    run("export", tmp_path / "far.ply", tmp_path / "b.ply", "--scale", 2, "--rotate", 0, 0, 90)
    found, _, offset = load_gaussians(tmp_path / "b.ply")
    np.testing.assert_allclose(offset, [0, 2000, 0], atol=1e-9)
    np.testing.assert_allclose(found.means, 2 * gaussians.means[:, [1, 0, 2]] * [-1, 1, 1], rtol=1e-6, atol=1e-5)


def test_a_scene_that_moves_far_keeps_its_precision(tmp_path):
    gaussians = random_gaussians(50, 1)
    save_gaussians(tmp_path / "near.ply", gaussians)
    run("export", tmp_path / "near.ply", tmp_path / "far.ply", "--move", 500000, 5400000, 0)
    found, _, offset = load_gaussians(tmp_path / "far.ply")
    np.testing.assert_array_equal(offset, [500000, 5400000, 0])
    np.testing.assert_array_equal(found.means, gaussians.means)


def test_gaussians_without_orientation_are_turned_and_merged(tmp_path):
    """They are read as they are, and not drawn."""
    gaussians = random_gaussians(200, 1)
    gaussians.quats[::3] = 0
    save_gaussians(tmp_path / "scene.ply", gaussians)
    run("export", tmp_path / "scene.ply", tmp_path / "turned.ply", "--rotate", 0, 0, 90)
    assert not load_gaussians(tmp_path / "turned.ply")[0].quats[::3].any()
    halves = halved(load_gaussians(tmp_path / "scene.ply")[0])
    assert len(halves) == 100 and np.isfinite(covariances(halves)).all() and halves.quats.any(axis=1).all()


@pytest.mark.parametrize("flags", [("--spz-version", 4), ("--spz-axes", "rub")])
def test_options_of_spz_need_one(flags, scene, tmp_path, capsys):
    with pytest.raises(SystemExit):
        run("export", scene, tmp_path / "out.sog", *flags)
    assert f"{flags[0]}: expected an .spz to" in capsys.readouterr().err


def test_levels_are_not_moved(scene, tmp_path, capsys):
    with pytest.raises(SystemExit):
        run("export", scene, tmp_path / "levels", "--scale", 2)
    assert "--scale, --rotate, --move: expected a file to write" in capsys.readouterr().err
