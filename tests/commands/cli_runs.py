"""Commands run in this process, and a small dataset for them."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from clsplat.camera import Camera
from clsplat.cli import main
from clsplat.gaussians import Gaussians
from clsplat.metrics import to_uint8
from clsplat.render import render
from clsplat.testing import synthetic_scene

SIZE = (40, 32)


def read_image(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB") if image.mode != "I;16" else image)


def write_dataset(folder: Path, count: int = 9) -> Gaussians:
    """Write a transforms.json dataset with renders of known Gaussians by the twins; return the Gaussians."""
    truth = synthetic_scene(40, seed=4)[0]
    rng = np.random.default_rng(0)
    truth.means[:] = rng.uniform(-0.6, 0.6, truth.means.shape)
    truth.log_scales[:] = np.log(0.15)
    truth.logit_opacities[:] = 1.5
    truth.sh[:, 0] = rng.uniform(-1, 1.5, (40, 3))
    folder.mkdir(parents=True, exist_ok=True)
    frames = []
    for i in range(count):
        angle = 2 * np.pi * i / count
        eye = [3 * np.sin(angle), -1.0, 3 * np.cos(angle)]
        camera = Camera.look_at(eye, [0, 0, 0], [0, -1, 0], 45, *SIZE)
        Image.fromarray(to_uint8(render(truth, camera, device="reference").rgb)).save(folder / f"{i}.png")
        # transforms.json holds camera to world, in OpenGL axes.
        matrix = np.linalg.inv(camera.viewmat) @ np.diag([1, -1, -1, 1])
        frames.append({"file_path": f"{i}.png", "transform_matrix": matrix.tolist()})
    intrinsics = {"fl_x": 45, "fl_y": 45, "cx": SIZE[0] / 2, "cy": SIZE[1] / 2, "w": SIZE[0], "h": SIZE[1]}
    (folder / "transforms.json").write_text(json.dumps(intrinsics | {"frames": frames}))
    return truth


def run(*arguments: object) -> None:
    main([str(a) for a in arguments])


def fails(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Run a command that must fail; return its error message, a single sentence."""
    with pytest.raises(SystemExit) as exit_:
        run(*arguments)
    assert exit_.value.code == 2
    error = capsys.readouterr().err
    assert "Traceback" not in error
    lines = [line for line in error.splitlines() if line.startswith("clsplat: ")]
    assert len(lines) == 1, error
    return lines[0]


TRAIN = (
    "--iterations",
    20,
    "--init.random-points",
    200,
    "--init.no-triangulate",
    "--checkpoint-every",
    10,
    "--eval-every",
    10,
)
