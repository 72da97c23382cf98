"""Datasets that are hard to train on, and the check that a training on one ends with a scene or a sentence."""

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from clsplat.cli import main
from clsplat.dataset import load_scene
from clsplat.formats import load_gaussians
from clsplat.gaussians import Gaussians
from clsplat.render import renderings
from clsplat.renderer import Renderer
from clsplat.training.presets import load_config

SHORT = ("--iterations", 40, "--eval-every", 0)
"""Options of a training that takes a second."""

AXES, CHANNELS = "xyz", ("red", "green", "blue")


class End(NamedTuple):
    """How a training ended.

    sentence: the error, or the warning that the training failed. error: whether it was an error. gaussians: the scene
    that was saved. gain: PSNR of the training photos beyond that of one colour for each, dB. said: all messages.
    """

    sentence: str | None
    error: bool
    gaussians: Gaussians | None
    gain: float
    said: str


def frame(view, matrix=None):
    """Frame of a transforms.json; `matrix` (4, 4) replaces the camera-to-world matrix in OpenGL axes."""
    camera = view.camera
    if matrix is None:
        matrix = np.linalg.inv(camera.viewmat) @ np.diag([1, -1, -1, 1])
    intrinsics = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    size = {"w": camera.width, "h": camera.height}
    return {"file_path": view.name, "transform_matrix": np.asarray(matrix).tolist(), **intrinsics, **size}


def write(folder: Path, scene, frames=None) -> Path:
    """Write a scene's training photos as a transforms.json, with its points if it has any; returns the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for view in scene.train:
        Image.fromarray(view.image).save(folder / view.name)
    meta = {"frames": [frame(view) for view in scene.train] if frames is None else frames}
    if len(scene.points):
        rows = np.zeros(len(scene.points), [*((axis, "<f8") for axis in AXES), *((c, "u1") for c in CHANNELS)])
        for i in range(3):
            rows[AXES[i]], rows[CHANNELS[i]] = scene.points[:, i], scene.colors[:, i]
        properties = [f"property double {axis}" for axis in AXES] + [f"property uchar {c}" for c in CHANNELS]
        header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *properties, "end_header"]
        (folder / "points.ply").write_bytes("\n".join([*header, ""]).encode() + rows.tobytes())
        meta["ply_file_path"] = "points.ply"
    (folder / "transforms.json").write_text(json.dumps(meta))
    return folder


def end(capsys, device, data: Path, out: Path, *options: object, size: str = "fixed") -> End:
    """Train with the command, and check that it ends with a scene that shows its photos, or with a sentence."""
    capsys.readouterr()
    try:
        cap = ("--max-gaussians", 500) if size == "fixed" else ()
        main([str(x) for x in ("train", data, "-o", out, *SHORT, "--size", size, *cap, *options)])
    except SystemExit as ended:
        said = capsys.readouterr().err
        assert ended.code == 2 and "Traceback" not in said
        (line,) = [line for line in said.splitlines() if line.startswith("clsplat: ")]
        assert not (out / "scene.ply").exists()
        return End(line, True, None, 0, said)
    said = capsys.readouterr().err
    failed = next((line for line in said.splitlines() if line.startswith("training failed: ")), None)
    gaussians = load_gaussians(out / "scene.ply")[0]
    assert all(np.isfinite(array).all() for array in gaussians.arrays().values())
    gain = gain_over_colors(gaussians, load_scene(data, load_config(out / "config.json").data).train, device)
    assert failed or gain > 0, "neither a scene nor a sentence"
    return End(failed, False, gaussians, gain, said)


def gain_over_colors(gaussians, views, device) -> float:
    """PSNR of photos, all taken together, beyond that of the mean colour of each, dB; levels of 8 bits are exact."""
    errors = variances = 0.0
    for view, shown in zip(views, renderings(Renderer(device), gaussians, [v.camera for v in views]), strict=True):
        photo = view.image / 255
        errors += np.mean((np.clip(shown.rgb, 0, 1) - photo) ** 2) / len(views)
        variances += photo.var(axis=(0, 1)).mean() / len(views)
    level = (1 / 255) ** 2
    return 10 * np.log10(max(variances, level) / max(errors, 1e-9))
