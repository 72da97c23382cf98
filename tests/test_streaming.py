"""Photos that stream from the disk: the same bytes as from memory, bounded memory, a sentence where one is lost."""

import gc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_runs import SIZE, write_dataset
from PIL import Image
from small_files import small_files
from small_run import CONFIG, cameras, same

from clsplat.config import CoarseConfig, DataConfig, InitConfig
from clsplat.dataset import load_scene
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.evaluate import evaluate
from clsplat.scene import DepthMap, Scene, View, in_turn
from clsplat.streaming import Files, PhotoStream, Source, StreamedView
from clsplat.training.loop import train
from clsplat.training.moving import still
from clsplat.training.session import view_at

PHOTO = 3 * SIZE[0] * SIZE[1]
INIT = InitConfig(triangulate=False, random_points=80, sh_degree=1)
SHORT = replace(CONFIG, strategy="error", max_gaussians=120, iterations=30, checkpoint_every=7, init=INIT)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "scene"
    write_dataset(folder, 13)
    return folder


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "clsplat"


def streamed(path: Path, data: DataConfig | None = None, photos: float = 2) -> Scene:
    """The scene with as many photos in memory."""
    scene = load_scene(path, data or DataConfig(), memory=round(photos * PHOTO))
    assert all(isinstance(view, StreamedView) for view in scene.train + scene.test)
    return scene


def masked(folder: Path) -> str:
    """Masks beside the photos: a corner of each, and all of one."""
    (folder / "masks").mkdir(exist_ok=True)
    for k in range(13):
        mask = np.full(SIZE[::-1], 255, np.uint8)
        mask[: 99 if k == 4 else k] = 0
        Image.fromarray(mask).save(folder / "masks" / f"{k}.png")
    return str(folder / "masks")


RUNS = {
    "plain": SHORT,
    "exposures": replace(SHORT, exposure=True),
    "poses": replace(SHORT, poses=True),
    "filter": replace(SHORT, filter_3d=True),
    "search": replace(SHORT, size="auto", iterations=60),
    "coarse": replace(SHORT, coarse=CoarseConfig(factor=4)),
    "backgrounds": replace(SHORT, data=DataConfig(random_background=True)),
    "masks": replace(SHORT, data=DataConfig(masks="masks")),
    "downscaled": replace(SHORT, data=DataConfig(downscale=2)),
    "depths": replace(SHORT, coarse=CoarseConfig(factor=2)),
}


def with_depths(scene: Scene) -> Scene:
    """The scene with depth maps of noise."""
    rng = np.random.default_rng(0)
    maps = [DepthMap(rng.uniform(1, 3, SIZE[::-1]).astype(np.float32)) for _ in scene.train]
    return replace(scene, train=[view.with_depth(depth) for view, depth in zip(scene.train, maps, strict=True)])


@pytest.mark.filterwarnings("ignore:.*their masks are black")
@pytest.mark.parametrize("kind", RUNS)
def test_two_photos_in_memory_make_the_same_bytes_as_all(
    dataset: Path, device: Device, tmp_path: Path, kind: str
) -> None:
    config = RUNS[kind]
    if config.data.masks:
        config = replace(config, data=replace(config.data, masks=masked(dataset)))
    whole, stream = load_scene(dataset, config.data), streamed(dataset, config.data)
    assert not any(isinstance(view, StreamedView) for view in whole.train)
    if kind == "depths":
        whole, stream = with_depths(whole), with_depths(stream)
        assert all(isinstance(view, StreamedView) and view.loaded().depth is view.depth for view in stream.train)
    expected, found = (train(s, config, tmp_path / n, device) for s, n in ((whole, "whole"), (stream, "stream")))
    assert same(found, expected)
    reports = [evaluate(expected, s.test, tmp_path / n) for s, n in ((whole, "whole"), (stream, "stream"))]
    assert reports[0] == reports[1]


def test_pixels_do_not_depend_on_the_order_in_which_photos_are_read(dataset: Path) -> None:
    whole, stream = load_scene(dataset, DataConfig()), streamed(dataset)
    order = np.random.default_rng(3).integers(0, len(whole.train), 60)
    for found, k in zip(in_turn([stream.train[k] for k in order]), order, strict=True):
        assert found.name == whole.train[k].name
        np.testing.assert_array_equal(found.image, whole.train[k].image)


def test_views_keep_streaming_through_changes_of_camera_and_pixels(dataset: Path) -> None:
    view = streamed(dataset).train[0]
    moved = view.with_camera(view.camera.translated(np.ones(3)))
    inverted = moved.changed(lambda v: replace(v, image=255 - v.image))
    assert isinstance(moved, StreamedView) and isinstance(inverted, StreamedView)
    np.testing.assert_array_equal(inverted.image, 255 - view.image)
    assert inverted.camera is moved.camera and inverted.loaded().camera is moved.camera
    assert inverted.digests == view.digests == moved.digests, "those of the file's photo"
    deep = view.with_depth(DepthMap(np.ones(SIZE[::-1], np.float32))).with_camera(view.camera)
    assert isinstance(deep, StreamedView) and deep.loaded().depth is deep.depth is not None
    deep = inverted.with_depth(DepthMap(np.ones(SIZE[::-1], np.float32)))
    assert isinstance(deep, StreamedView) and deep.loaded().depth is deep.depth is not None
    np.testing.assert_array_equal(deep.image, inverted.image)
    assert deep.with_depth(None).depth is None is inverted.depth
    assert type(replace(view, name="other")) is View, "an ordinary view, in memory"


def test_what_is_known_of_changed_views_is_known_without_reading_them(
    dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    view = streamed(dataset).train[0]
    moves = {view.name: np.arange(20)[None].repeat(16, axis=0) < 5}
    darker = view.changed(lambda v: replace(v, image=v.image // 2))
    without = still([darker], moves)[0].with_camera(view.camera)
    reads = []
    read = PhotoStream.__call__
    monkeypatch.setattr(PhotoStream, "__call__", lambda self, name: reads.append(name) or read(self, name))
    assert darker.depth is darker.mask is None and darker.is_used and without.is_used and not reads
    deep = darker.with_depth(DepthMap(np.ones(SIZE[::-1], np.float32))).changed(lambda v: v)
    assert deep.depth and not np.isnan(deep.depth.values).any() and reads
    (again,) = still([deep], moves)
    assert without.mask is not None and not without.mask[0, 0] and without.mask[0, -1]
    assert again.depth and (np.isnan(again.depth.values) == ~without.mask).all()
    np.testing.assert_array_equal(without.loaded().mask, without.mask)


def test_no_photo_is_decoded_before_it_is_needed(
    dataset: Path, device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[str] = []
    decode = PhotoStream._read
    monkeypatch.setattr(PhotoStream, "_read", lambda self, name: read.append(name) or decode(self, name))
    scene = streamed(dataset)
    assert not read

    def stop(record: dict[str, Any]) -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        train(scene, SHORT, tmp_path, device, progress=stop)
    first = [view_at(k, scene.train, SHORT.seed).name for k in (1, 2)]
    assert set(read) <= set(first) and first[0] in read


# ---- memory


def test_a_stream_keeps_what_fits_and_drops_what_was_used_longest_ago() -> None:
    decoded: list[str] = []
    camera = streamed_camera()

    def source(name: str) -> Source:
        return Source(
            lambda: decoded.append(name) or View(name, camera, np.zeros((2, 2, 3), np.uint8)), camera, ("image",)
        )

    stream = PhotoStream({name: source(name) for name in "abcde"}, 4 * 12)
    kept = 4 - stream.ahead
    for name in ("abcde"[:kept]) * 2:
        stream(name)
    assert decoded == list("abcde"[:kept]), "the second time from memory"
    stream("e"), stream("abcde"[kept - 1])
    assert len(decoded) == kept + (2 if kept == 1 else 1)
    stream("a")
    assert decoded[-1] == "a"


def streamed_camera() -> Any:
    from clsplat.camera import Camera

    return Camera(np.eye(4), 2.0, 2.0, 1.0, 1.0, 2, 2)


# ---- what goes wrong


def damaged_at(iteration: int, path: Path, how: str) -> Any:
    def damage(record: dict[str, Any]) -> None:
        if record["iteration"] == iteration:
            if how == "removed":
                path.unlink()
            elif how == "damaged":
                path.write_bytes(path.read_bytes()[:60])
            else:
                Image.new("RGB", SIZE, (9, 9, 9)).save(path)

    return damage


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("removed", r"cannot read .*7\.png.*No such file"),
        ("damaged", r"cannot read .*7\.png as an image"),
        ("replaced", r"photo 7\.png: expected the pixels and mask that the run has read before, found others"),
    ],
)
def test_a_lost_photo_ends_in_a_sentence_and_the_run_goes_on_with_it(tmp_path: Path, how: str, message: str) -> None:
    device = Device()
    device.is_cpu = True  # shadows the cached property: a GPU would keep the photo
    write_dataset(tmp_path / "data", 13)
    photo = tmp_path / "data" / "7.png"
    saved = photo.read_bytes()
    expected = train(load_scene(tmp_path / "data", DataConfig()), SHORT, tmp_path / "whole", device)
    with pytest.raises(InputError, match=rf"^iteration \d+: {message}.*--resume continues from it$"):
        train(streamed(tmp_path / "data"), SHORT, tmp_path / "out", device, progress=damaged_at(14, photo, how))
    photo.write_bytes(saved)
    assert same(train(streamed(tmp_path / "data"), SHORT, tmp_path / "out", device, resume=True), expected)


def test_a_run_resumes_with_the_photos_that_it_has_read(device: Device, tmp_path: Path) -> None:
    """With some photos in memory or all, whichever way it began; each photo is needed again after the resumption."""
    config = replace(SHORT, iterations=45)
    write_dataset(tmp_path / "data", 13)

    def interrupt(record: dict[str, Any]) -> None:
        if record["iteration"] == 15:
            raise KeyboardInterrupt

    for name, before, after in (("a", 2, 99), ("b", 99, 2)):
        scenes = [load_scene(tmp_path / "data", DataConfig(), memory=n * PHOTO) for n in (before, after)]
        with pytest.raises(KeyboardInterrupt):
            train(scenes[0], config, tmp_path / name, device, progress=interrupt)
        Image.new("RGB", SIZE, (9, 9, 9)).save(tmp_path / "data" / "7.png")
        other = load_scene(tmp_path / "data", DataConfig(), memory=after * PHOTO)
        with pytest.raises(InputError, match=r"found other pixels|has read before, found others"):
            train(other, config, tmp_path / name, device, resume=True)
        write_dataset(tmp_path / "data", 13)
        again = train(
            load_scene(tmp_path / "data", DataConfig(), memory=after * PHOTO),
            config,
            tmp_path / name,
            device,
            resume=True,
        )
        assert same(again, train(scenes[0], config, tmp_path / f"whole {name}", device))


# ---- copies


def copies(cache: Path) -> list[Path]:
    return sorted(cache.glob("photos-*/*.npy"))


def test_reduced_photos_are_copied_and_the_copies_go_with_the_scene(dataset: Path, cache: Path) -> None:
    scene = streamed(dataset, DataConfig(downscale=2), photos=0.5)
    expected = [view.image for view in in_turn(scene.train)]
    assert len(copies(cache)) == len(scene.train)
    for path in copies(cache)[:3]:
        path.write_bytes(path.read_bytes()[:90])
    for path in copies(cache)[3:6]:
        path.write_bytes(path.read_bytes()[:-1] + b"?")
    assert all(np.array_equal(a.image, b) for a, b in zip(in_turn(scene.train), expected, strict=True))
    del scene
    gc.collect()
    assert not list(cache.iterdir())


def test_copies_of_a_process_that_died_are_removed(cache: Path) -> None:
    dead = cache / "photos-dead"
    dead.mkdir(parents=True)
    (dead / "a.image.npy").write_bytes(b"1")
    living = Files.temporary()
    other = Files.temporary()
    assert not dead.exists() and len(list(cache.iterdir())) == 2
    del living, other


def test_a_full_disk_costs_the_copies_only(dataset: Path) -> None:
    expected = load_scene(dataset, DataConfig(downscale=2)).train
    scene = streamed(dataset, DataConfig(downscale=2), photos=0.5)
    with small_files(512), pytest.warns(UserWarning, match="photos are decoded each time that they are used"):
        found = [view.image for view in in_turn(scene.train)]
    assert all(np.array_equal(a, b.image) for a, b in zip(found, expected, strict=True))


def test_a_cache_that_takes_no_files_costs_the_copies_only(dataset: Path, cache: Path) -> None:
    cache.parent.mkdir(parents=True)
    cache.write_text("a file where the folder would be")
    with pytest.warns(UserWarning, match="cannot write copies of photos to the cache: .*each time"):
        scene = streamed(dataset, DataConfig(downscale=2), photos=0.5)
    expected = load_scene(dataset, DataConfig(downscale=2)).train
    assert all(np.array_equal(a.image, b.image) for a, b in zip(in_turn(scene.train), expected, strict=True))


def test_a_reader_is_not_stopped_by_another_one_that_gives_up_the_copies(tmp_path: Path) -> None:
    """As where two threads meet a full disk."""
    view = View("a", streamed_camera(), np.zeros((2, 2, 3), np.uint8))
    found = iter([Files(tmp_path)])

    class GivenUp(PhotoStream):
        _copies = property(lambda self: next(found, None), lambda self, copies: None)

    stream = GivenUp({"a": Source(lambda: view, view.camera, ("image",))}, 12)
    assert view.digests
    stream.expect("a", view.digests)
    np.testing.assert_array_equal(stream("a").image, view.image)


def test_photos_in_the_order_of_fortran_are_written_as_they_are(tmp_path: Path) -> None:
    view = View("a", cameras(1)[0], np.random.default_rng(0).integers(0, 256, (*SIZE[::-1], 3), np.uint8))
    view = replace(view, image=np.asfortranarray(view.image), mask=np.asfortranarray(view.image[:, :, 0] > 99))
    Files(tmp_path).write(view)
    found = Files(tmp_path).read("a", view.camera)
    assert found and found.digests == view.digests
