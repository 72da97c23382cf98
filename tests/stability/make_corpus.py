"""Write the corpus that fuzzing starts from; found cases stay.

Run it from the root of the project as
``PYTHONPATH=.:tests:tests/dataset:tests/formats python tests/stability/make_corpus.py``.
The files come from clsplat's own writers and those of its tests; the pictures cover the kinds that Pillow writes.
"""

import io
import json
import tempfile
import warnings
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from mutations import packed
from PIL import Image, PngImagePlugin
from readers import CHECKPOINT_CONFIG, CORPUS, READERS
from test_colmap import write_bin, write_txt
from test_ksplat import scene as ksplat_scene
from test_loading import write_transforms

from clsplat.config import SfmConfig, TrainConfig
from clsplat.dataset.sfm import reconstruction
from clsplat.formats import FORMATS, save_gaussians
from clsplat.formats.sog import META
from clsplat.formats.spz import save_spz
from clsplat.formats.streamed_sog import LOD_META
from clsplat.inputs import Inputs, Photo
from clsplat.scene import Scene, View
from clsplat.testing import synthetic_scene
from clsplat.training.autosize.rule import Candidate, Search, SmallSide, Trial
from clsplat.training.checkpoint import save_state
from clsplat.training.loop import initial_state
from clsplat.training.presets import PRESETS, load_preset

RNG = np.random.default_rng(0)


def put(reader, name, content):
    """Add a file to the corpus of a reader."""
    assert reader in READERS
    (CORPUS / reader).mkdir(parents=True, exist_ok=True)
    (CORPUS / reader / name).write_bytes(content)


def tree(folder):
    """A ZIP of the files in a folder."""
    return packed(
        {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}
    )


def picture(image, form="PNG", **options):
    """A picture as a file."""
    file = io.BytesIO()
    image.save(file, format=form, **options)
    return file.getvalue()


def gaussians(folder):
    for degree in (0, 2):
        scene = synthetic_scene(6, sh_degree=degree)[0].astype(np.float32)
        for suffix in FORMATS:
            path = folder / f"scene{suffix}"
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                save_gaussians(path, scene, "antialiased", [1e4, 0, 2])
            put(suffix[1:].replace(".", "-"), f"degree-{degree}", path.read_bytes())
    from plyfile import PlyData

    text = PlyData.read(folder / "scene.ply")
    text.text = True
    text.write(folder / "text.ply")
    put("ply", "text", (folder / "text.ply").read_bytes())
    sog_version_1()
    spz_version_4(folder)
    ksplat()
    streamed_sog(folder)


def sog_version_1():
    pixels = np.full((4, 4, 4), 255, np.uint8)
    webp = picture(Image.fromarray(pixels), "WEBP", lossless=True, exact=True)
    group = {"mins": [-1.0] * 3, "maxs": [1.0] * 3}
    meta = {
        "means": {"shape": [9, 3], **group, "files": ["a.webp", "a.webp"]},
        "scales": {**group, "files": ["a.webp"]},
        "quats": {"files": ["a.webp"]},
        "sh0": {"mins": [-1.0] * 4, "maxs": [1.0] * 4, "files": ["a.webp"]},
    }
    put("sog", "version-1", packed({META: json.dumps(meta).encode(), "a.webp": webp}))


def spz_version_4(folder):
    scene = synthetic_scene(6, sh_degree=1)[0].astype(np.float32)
    save_spz(folder / "four.spz", scene, "antialiased", version=4, axes="rdf")
    put("spz", "version-4", (folder / "four.spz").read_bytes())


def ksplat():
    """As many Gaussians as make a partial bucket; files of the format's own library are in tests/formats/foreign."""
    for level in range(3):
        put("ksplat", f"level-{level}", ksplat_scene(level, ((5, 2), (1, 2))))


def streamed_sog(folder):
    root = folder / "streamed"
    root.mkdir()
    for name, n in (("a.sog", 6), ("sky.sog", 2)):
        save_gaussians(root / name, synthetic_scene(n, sh_degree=1)[0].astype(np.float32))
    nodes = [{"lods": {"0": {"file": 0, "offset": first, "count": 3}}} for first in (3, 0)]
    meta = {
        "version": 1,
        "lodLevels": 1,
        "filenames": ["a.sog"],
        "environment": "sky.sog",
        "tree": {"children": nodes},
    }
    (root / LOD_META).write_text(json.dumps(meta))
    put("streamed-sog", "two-nodes", tree(root))


def pictures():
    rgb = Image.fromarray(RNG.integers(0, 255, (12, 16, 3), dtype=np.uint8))
    grey = rgb.convert("L")
    exif = Image.Exif()
    exif[0x0112] = 6
    deep = Image.fromarray(RNG.integers(0, 65535, (12, 16), dtype=np.uint16))
    text = PngImagePlugin.PngInfo()
    text.add_text("Software", "clsplat", zip=True)
    images = {
        "rgb.png": picture(rgb, exif=exif, pnginfo=text),
        "palette.png": picture(rgb.quantize(8), transparency=3),
        "grey.png": picture(grey, transparency=7),
        "alpha.png": picture(rgb.convert("RGBA")),
        "grey-alpha.png": picture(grey.convert("LA")),
        "bits-16.png": picture(deep),
        "bit-1.png": picture(grey.convert("1")),
        "rgb.jpg": picture(rgb, "JPEG", exif=exif, quality=80),
        "cmyk.jpg": picture(rgb.convert("CMYK"), "JPEG"),
        "progressive.jpg": picture(rgb, "JPEG", progressive=True, icc_profile=b"profile", comment="x"),
        "lossless.webp": picture(rgb.convert("RGBA"), "WEBP", lossless=True, exif=exif),
        "lossy.webp": picture(rgb, "WEBP"),
        "rgb.tif": picture(rgb, "TIFF", exif=exif),
        "deflate.tif": picture(rgb, "TIFF", compression="tiff_deflate"),
        "bits-16.tif": picture(deep, "TIFF"),
        "rgb.bmp": picture(rgb, "BMP"),
        "moving.png": picture(rgb, save_all=True, append_images=[rgb.rotate(180)]),
    }
    for name, content in images.items():
        put("photo", name, content)
    black_and_white = Image.fromarray(RNG.integers(0, 2, (12, 16), dtype=np.uint8) * 255)
    put("mask", "grey.png", picture(black_and_white))
    put("mask", "bit-1.png", picture(black_and_white.convert("1")))
    put("mask", "alpha.png", picture(black_and_white.convert("RGBA")))
    put("mask", "palette.png", picture(black_and_white.quantize(2)))


S = 0.5**0.5
CAMERAS = [
    (1, "PINHOLE", 16, 12, (14.0, 14.0, 8.0, 6.0)),
    (2, "OPENCV", 16, 12, (14.0, 14.0, 8.0, 6.0, 0.01, 0.0, 0.0, 0.001)),
    (3, "OPENCV_FISHEYE", 16, 12, (8.0, 8.0, 8.0, 6.0, 0.01, 0.0, 0.0, 0.0)),
]
IMAGES = [
    ("a.png", 1, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 2.0)),
    ("b.png", 2, (S, 0.0, S, 0.0), (1.0, 2.0, 3.0)),
    ("c.png", 3, (0.0, 1.0, 0.0, 0.0), (0.5, 0.0, 2.0)),
]
PANORAMA = [(1, "EQUIRECTANGULAR", 16, 8, (16.0, 8.0))]


def model(folder, write, cameras=CAMERAS, images=IMAGES):
    """A COLMAP model and its photos."""
    points = [(tuple(xyz), (1, 2, 255)) for xyz in RNG.normal(size=(5, 3)).round(3).tolist()]
    write(folder / "sparse" / "0", cameras, images, points)
    sizes = {number: (width, height) for number, _, width, height, _ in cameras}
    (folder / "images").mkdir()
    for name, camera, _, _ in images:
        Image.new("RGB", sizes[camera], (9, 100, 200)).save(folder / "images" / name)


def datasets(folder):
    for reader, write in (("colmap-bin", write_bin), ("colmap-txt", write_txt)):
        model(folder / reader, write)
        put(reader, "three", tree(folder / reader))
        model(folder / f"{reader}-panorama", write, PANORAMA, IMAGES[:1])
        put(reader, "panorama", tree(folder / f"{reader}-panorama"))
    root = folder / "transforms"
    write_transforms(root, ["images/a.png", "images/b.png"])
    put("transforms", "least", tree(root))
    meta = json.loads((root / "transforms.json").read_text())
    extra = {"w": 16, "h": 12, "fl_y": 20.0, "cx": 8, "cy": 6, "k1": 0.01, "p1": 0.001, "camera_model": "OPENCV"}
    meta |= extra | {"ply_file_path": "points.ply", "test_filenames": ["images/a.png"]}
    meta["frames"][0]["mask_path"] = "mask.png"
    Image.new("L", (16, 12), 255).save(root / "mask.png")
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    colours = "".join(f"property uchar {c}\n" for c in ("red", "green", "blue"))
    head = f"ply\nformat ascii 1.0\nelement vertex 2\n{axes}{colours}end_header\n"
    (root / "points.ply").write_text(head + "1 2 3 4 5 6\n-1 0 2.5 255 0 1\n")
    (root / "transforms.json").write_text(json.dumps(meta))
    put("transforms", "most", tree(root))
    fisheye = {"camera_angle_x": 1.2, "camera_model": "OPENCV_FISHEYE", "k1": 0.01, "frames": meta["frames"]}
    (root / "transforms.json").unlink()
    (root / "transforms_train.json").write_text(json.dumps(fisheye))
    Image.new("RGB", (16, 8), (9, 100, 200)).save(root / "images" / "c.png")
    panorama = [meta["frames"][1] | {"file_path": "images/c.png"}]
    whole = fisheye | {"camera_model": "EQUIRECTANGULAR", "frames": panorama}
    (root / "transforms_test.json").write_text(json.dumps(whole))
    put("transforms", "split", tree(root))


def recovered(folder):
    import pycolmap

    root = folder / "recovered"
    model(root, write_bin, CAMERAS[:1], [(f"{k}.png", 1, (1.0, 0.0, 0.0, 0.0), (k, 0.0, 2.0)) for k in range(3)])
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=3, num_points3D=4)
    scene = pycolmap.synthesize_dataset(options)
    scene.write_binary(root / "sparse" / "0")
    hashes = reconstruction._hashes(root)
    record = {"photos": ".", "registered": 3, "options": asdict(SfmConfig()), "hashes": hashes}
    (root / "sparse" / reconstruction.RECORD).write_text(json.dumps(record, indent=1))
    put("recovered", "three", tree(root))


def checkpoint(folder):
    _, camera = synthetic_scene(1)
    photo = np.zeros((camera.height, camera.width, 3), np.uint8)
    views = [View(name, camera, photo) for name in "ab"]
    scene = Scene(views, [], RNG.normal(size=(4, 3)), np.zeros((4, 3), np.uint8))
    config = CHECKPOINT_CONFIG
    state = initial_state(scene, config)
    numbers = [float(x) for x in range(20)]
    inputs = Inputs({name: Photo("ab", "", numbers) for name in "ab"}, {}, "cd", "a device, driver 1")
    candidate = Candidate(2, 4, 1, 20.5, [20.0, 21.0], 0.1)
    side = SmallSide(state.rows, candidate)
    search = Search(8, 2.0, True, [Trial(True, candidate, candidate)], [candidate], 0, [[20.0, 21.0]], side)
    state.filter.pixels = np.ones(len(state.gaussians), np.float32)
    full = replace(state, iteration=5, seconds=1.5, losses=[0.5, 0.25], search=search, inputs=inputs)
    path = folder / "checkpoint.npz"
    for name, saved in (("start", replace(state, inputs=inputs)), ("search", full)):
        save_state(path, saved, config)
        put("checkpoint", name, path.read_bytes())


def settings():
    path = CORPUS / "ply" / "degree-0"
    lines = [{"iteration": k, "num_gaussians": 6, "seconds": k / 10, "loss": 0.1} for k in (10, 20)]
    lines[-1] |= {"psnr": 20.5, "ssim": 0.5}
    log = "".join(json.dumps(line) + "\n" for line in lines).encode()
    config = json.dumps({"data_path": "photos", **asdict(TrainConfig())}, indent=1).encode()
    put("run", "finished", packed({"log.jsonl": log, "config.json": config, "scene.ply": path.read_bytes()}))
    put("run", "in-progress", packed({"log.jsonl": log, "config.json": config}))
    put("config-json", "whole", config)
    for name in PRESETS:
        put("config-json", name, json.dumps({"iterations": load_preset(name).iterations}).encode())
    part = b"# a part\niterations: 100\nsize: fixed\noptim:\n  means_lr: 1.0e-4\ninit: {opacity: 0.1}\n"
    put("config-yaml", "part", part)
    anchors = b"iterations: &n 100\neval_every: *n\ndevice: ~\nseed: 0x10\nrender:\n  mode: classic\n"
    put("config-yaml", "anchors", anchors)
    key = {"scene": "fox", "method": "auto", "max_gaussians": None, "iterations": 8, "seed": 0, "device": "here"}
    about = {"driver": "1", "version": "0.1", "commit": "abc", "load": 0.5, "date": "2026-11-22T00:00:00+00:00"}
    about |= {"compute_units": 2, "settings": {"downscale": 4}}
    values = {"iteration": 4, "psnr": 20.0, "ssim": 0.5, "flip": None, "seconds": 1.0, "cpu_seconds": 2.0}
    last = values | {"iteration": 8, "num_gaussians": 9, "spz_bytes": 99, "memory_bytes": 999, "fps": 30.0}
    rows = [key | values | about, key | last | about, key | {"method": "mcmc", "failed": "no memory"} | about]
    put("results", "three", "".join(json.dumps(row) + "\n" for row in rows).encode())


def depths():
    known = np.array([[0, 300, 65535], [1000, 2, 7]], np.uint16)
    put("depth-png", "bit-16.png", picture(Image.fromarray(known)))
    for kind in ("f2", "f4", "f8", "i4", "u2"):
        file = io.BytesIO()
        np.save(file, np.minimum(known, 9).astype(kind))
        put("depth-npy", kind, file.getvalue())


def main():
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        gaussians(folder)
        pictures()
        datasets(folder)
        recovered(folder)
        checkpoint(folder)
        settings()
    depths()


if __name__ == "__main__":
    main()
