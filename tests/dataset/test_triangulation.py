"""Points triangulated from rendered photos with known cameras must lie on the planes that the photos show."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from test_reconstruction import cameras, take_photos

from clsplat.camera import Camera
from clsplat.cli import main
from clsplat.config import DataConfig
from clsplat.dataset import load_scene, with_points
from clsplat.dataset.coverage import projected
from clsplat.dataset.near_planes import near_plane
from clsplat.dataset.sfm.triangulation import NEIGHBOURS, POINTS_TARGET, TRIANGULATED_MIN, filled, pairs, triangulate
from clsplat.errors import InputError
from clsplat.formats import load_gaussians
from clsplat.panorama import FACES
from clsplat.scene import View

PIXEL = 3.2 / 300
"""Size of a pixel of the four photos at the corner, in world units."""


def views(photos, seen_by):
    return [View(f"{i}.png", camera, photo) for i, (camera, photo) in enumerate(zip(seen_by, photos, strict=True))]


def off_the_corner(points):
    """Distances from the nearest of the planes x = 0, y = 0 and z = 0."""
    return np.abs(points).min(axis=1)


@pytest.fixture(scope="module")
def posed():
    """The four photos with their cameras."""
    return views(take_photos(0), cameras())


def write_transforms(folder, views, **more):
    """Write a dataset with poses but no points. Photos smaller than their cameras count as smaller copies."""
    frames = []
    for view in views:
        Image.fromarray(view.image).save(folder / view.name)
        pose = np.linalg.inv(view.camera.viewmat) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": view.name, "transform_matrix": pose.tolist()})
    camera = views[0].camera
    lens = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    meta = {**lens, "w": camera.width, "h": camera.height, "frames": frames, **more}
    (folder / "transforms.json").write_text(json.dumps(meta))
    return folder


def test_points_lie_on_the_planes_and_have_their_colours(posed):
    points, colors, _ = triangulate(posed)
    assert points.dtype == np.float64 and colors.dtype == np.uint8 and points.shape == colors.shape
    assert len(points) > 3 * TRIANGULATED_MIN
    # Features are located to a fraction of a pixel; 11 degrees between two photos make the error in depth 5 times
    # larger.
    assert np.median(off_the_corner(points)) < 0.3 * PIXEL
    assert np.quantile(off_the_corner(points), 0.95) < 5 * PIXEL
    camera, photo = posed[0].camera, posed[0].image
    at = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    u = (camera.fx * at[:, 0] / at[:, 2] + camera.cx).astype(int)
    v = (camera.fy * at[:, 1] / at[:, 2] + camera.cy).astype(int)
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    shown = photo[v[inside], u[inside]].astype(float)
    # Colours are means over photos and within a pixel. Two arbitrary places of the texture differ by about 60.
    assert np.median(np.abs(shown - colors[inside])) < 15


def test_the_same_photos_give_the_same_points(posed):
    first, second = triangulate(posed), triangulate(iter(posed))
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_array_equal(first[1], second[1])
    assert first.shown.keys() == second.shown.keys()


def test_photos_show_the_points_of_their_features(posed):
    points, _, shown = triangulate(posed)
    assert shown.keys() == {view.name for view in posed}
    assert (np.bincount(np.concatenate(list(shown.values())), minlength=len(points)) >= 2).all()
    for view in posed:
        _, _, inside = projected(view.camera, points[shown[view.name]])
        assert inside.mean() > 0.99, "a feature may lie on the edge"


def test_masked_pixels_make_no_points(posed):
    masked = []
    for view in posed:
        y, x = np.mgrid[: view.camera.height, : view.camera.width] + 0.5
        rays = view.camera.rays(x, y) @ view.camera.viewmat[:3, :3]
        reach = np.where(rays < 0, -view.camera.position / rays, np.inf)
        masked.append(replace(view, mask=reach.argmin(axis=-1) != 2))  # not the floor
    points, *_ = triangulate(masked)
    on_floor, unmasked = (np.mean(p[:, 2] < 4 * PIXEL) for p in (points, triangulate(posed)[0]))
    # A feature covers several pixels, so that its centre can lie beyond the edge of the mask.
    assert len(points) > TRIANGULATED_MIN and on_floor < 0.05 < unmasked
    # Photos without a mask are used completely, even if others have one.
    assert len(triangulate([*masked[:2], *posed[2:]])[0]) > len(points)


def test_fisheyes_are_projected_as_such():
    fisheyes = [replace(c, model="fisheye", distortion=(0.1, -0.05, 0.02, 0.0)) for c in cameras()]
    points, *_ = triangulate(views(take_photos(0, fisheyes), fisheyes))
    assert len(points) > 3 * TRIANGULATED_MIN and np.median(off_the_corner(points)) < 0.3 * PIXEL


def test_photos_that_show_nothing_make_no_points(posed):
    for photos in (posed[:1], [replace(v, image=np.full_like(v.image, 90)) for v in posed]):
        points, colors, _ = triangulate(photos)
        assert points.shape == colors.shape == (0, 3)


@pytest.mark.parametrize(
    "lens", [{"fx": 1e-30, "fy": 1e-30}, {"fx": 1e30, "fy": 1e30}, {"cx": 1e30}, {"fx": 1e-3, "fy": 1e6}], ids=str
)
def test_cameras_that_cannot_be_make_no_points(posed, lens):
    wrong = [replace(view, camera=replace(view.camera, **lens)) for view in posed]
    assert len(triangulate(wrong)[0]) == 0


@pytest.mark.parametrize("factor", [0.0, 1e20, 1e37])
def test_cameras_at_one_place_or_out_of_the_world_make_no_points(posed, factor):
    def moved(view):
        viewmat = view.camera.viewmat.copy()
        viewmat[:3, 3] *= factor
        return replace(view, camera=replace(view.camera, viewmat=viewmat))

    assert len(triangulate(map(moved, posed))[0]) == 0


def test_photos_of_one_row_are_left_out(posed):
    """COLMAP reduces them to zero rows and crashes."""
    row = replace(posed[0], image=posed[0].image[:1].repeat(13, axis=1))
    row = replace(row, camera=replace(row.camera, width=row.image.shape[1], height=1))
    np.testing.assert_array_equal(triangulate([row, *posed])[0], triangulate(posed)[0])


def test_only_cameras_that_colmap_knows_are_taken(posed):
    flat = replace(posed[0], camera=replace(posed[0].camera, model="orthographic"))
    with pytest.raises(InputError, match=r"0\.png: expected a pinhole or fisheye camera.*orthographic"):
        triangulate([flat, *posed[1:]])


def test_photos_are_matched_with_the_nearest_that_look_the_same_way():
    def at(x, target):
        return Camera.look_at((x, 0, 0), target, (0, 1, 0), 50, 40, 30)

    row = [at(float(x), (float(x), 0, 9)) for x in range(3 * NEIGHBOURS)]
    assert all(j - i <= NEIGHBOURS for i, j in pairs(row)) and (0, NEIGHBOURS) in pairs(row)
    assert pairs(row) == sorted(set(pairs(row))) and len(pairs(row)) > 2 * len(row)
    assert pairs([at(0, (0, 0, 9)), at(1, (1, 0, -9)), at(2, (2, 0, 9))]) == [(0, 2)]
    # The faces of a panorama have one position, as has a camera on a tripod.
    assert pairs([at(0, (0, 0, 9)), at(0, (1, 0, 9))]) == []
    assert pairs([]) == []


def test_a_dataset_of_poses_gets_points_from_photos_of_full_size(posed, tmp_path):
    config = DataConfig(downscale=4, test_every=0)
    path = write_transforms(tmp_path, posed)
    scene = load_scene(path, config)
    assert not len(scene.points) and scene.train[0].image.shape == (60, 80, 3)
    found = with_points(scene, path, config)
    points, colors, _ = triangulate(load_scene(path, DataConfig(test_every=0)).train)
    assert len(points) < POINTS_TARGET == len(found.points) == len(found.colors)
    np.testing.assert_array_equal(found.points[: len(points)], points)
    np.testing.assert_array_equal(found.colors[: len(points)], colors)
    assert [view.name for view in found.train] == [view.name for view in scene.train]
    nears = [view.camera.near for view in found.train]
    expected = [near_plane(view.camera, found.points) for view in scene.train]
    np.testing.assert_allclose(nears, expected, rtol=0.01)  # of a part of the points
    assert min(nears) > 10 * max(view.camera.near for view in scene.train)
    assert with_points(found, tmp_path / "not read again", config) is found


def test_only_photos_that_train_make_points(posed, tmp_path):
    config = DataConfig(test_every=4)
    path = write_transforms(tmp_path, posed)
    scene = load_scene(path, config)
    assert [view.name for view in scene.train] == ["1.png", "2.png", "3.png"]
    points, *_ = triangulate(scene.train)
    assert len(points) >= TRIANGULATED_MIN
    np.testing.assert_array_equal(with_points(scene, path, config).points[: len(points)], points)


def test_panoramas_that_train_whole_make_points_by_their_faces(tmp_path, monkeypatch):
    spheres = [Camera.panorama(camera.viewmat, 512) for camera in cameras()]
    path = write_transforms(tmp_path, views(take_photos(0, spheres), spheres), camera_model="EQUIRECTANGULAR")
    used = []

    def noted(views, verbose):
        views = list(views)
        used.extend(view.name for view in views)
        return triangulate(views, verbose)

    monkeypatch.setattr("clsplat.dataset.loading.triangulate", noted)
    config = DataConfig(test_every=4, panoramas="whole")
    scene = load_scene(path, config)
    assert [view.name for view in scene.train] == ["1.png", "2.png", "3.png"]
    found = with_points(scene, path, config)
    assert used == sorted(f"{k}_{face}.png" for k in (1, 2, 3) for face in FACES)
    assert [view.name for view in found.train] == [view.name for view in scene.train]
    size_of_a_pixel = 3.2 / spheres[0].fx
    assert len(found.points) == POINTS_TARGET and np.median(off_the_corner(found.points)) < size_of_a_pixel


def test_points_are_filled_up_between_neighbours(posed):
    points, colors, _ = triangulate(posed)
    more, blended = filled(points, colors)
    assert more.shape == blended.shape == (POINTS_TARGET, 3) and blended.dtype == np.uint8
    np.testing.assert_array_equal(more[: len(points)], points)
    # Neighbours mostly lie on one plane of the corner; points between them then lie on it as well.
    assert np.median(off_the_corner(more[len(points) :])) < PIXEL
    assert (more.min(axis=0) == points.min(axis=0)).all() and (more.max(axis=0) == points.max(axis=0)).all()
    np.testing.assert_allclose(blended.mean(axis=0), colors.mean(axis=0), atol=5)
    np.testing.assert_array_equal(filled(points, colors)[0], more)
    enough = filled(more, blended)
    assert enough[0] is more and enough[1] is blended


def test_points_of_a_scene_far_away_are_where_its_cameras_are(posed, tmp_path):
    far = np.array([4e5, 5e6, 300.0])
    path = write_transforms(tmp_path, [replace(v, camera=v.camera.translated(-far)) for v in posed])
    config = DataConfig(test_every=0)
    scene = load_scene(path, config)
    assert scene.offset.any()
    points = with_points(scene, path, config).points
    assert len(points) > 3 * TRIANGULATED_MIN
    assert np.median(off_the_corner(points + scene.offset - far)) < 0.3 * PIXEL


def test_a_training_starts_from_them_unless_told_not_to(posed, tmp_path, capsys):
    path = write_transforms(tmp_path, posed)
    options = ["train", str(path), "--iterations", "2", "--size", "fixed", "--eval-every", "0"]
    options += ["--max-gaussians", "500"]
    main([*options, "-o", str(tmp_path / "a")])
    assert f"start: {POINTS_TARGET} points, from photos and poses" in capsys.readouterr().err
    main([*options, "-o", str(tmp_path / "b"), "--init.no-triangulate"])
    assert "start:" not in capsys.readouterr().err
    near, far = (off_the_corner(load_gaussians(tmp_path / run / "scene.ply")[0].means) for run in "ab")
    assert np.median(near) < 3 * PIXEL < 10 * PIXEL < np.median(far)


def test_a_training_of_photos_without_features_starts_at_random(posed, tmp_path, capsys):
    path = write_transforms(tmp_path, [replace(v, image=np.full_like(v.image, 90)) for v in posed])
    options = ["train", str(path), "-o", str(tmp_path / "a"), "--iterations", "1", "--max-gaussians", "50"]
    main([*options, "--eval-every", "0"])
    assert "start: random" in capsys.readouterr().err
