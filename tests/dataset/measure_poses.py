"""The poses of a dataset without its points, as a transforms.json: what triangulation and near planes gain.

python tests/dataset/measure_poses.py castle_p30 OUT
clsplat bench quality OUT:downscale=4 OUT:downscale=4:thin=2 --methods auto
"""

import json
import sys
from pathlib import Path

import numpy as np

from clsplat.config import DataConfig
from clsplat.dataset import load_scene


def main(data: Path, out: Path) -> None:
    """Write OUT/transforms.json, and a link to the photos."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "images").symlink_to((data / "images").resolve())
    scene = load_scene(data, DataConfig())
    frames = []
    for view in sorted(scene.train + scene.test, key=lambda view: view.name):
        c = view.camera
        pose = np.linalg.inv(c.viewmat) @ np.diag([1, -1, -1, 1])
        lens = {"fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, "w": c.width, "h": c.height}
        frames.append({"file_path": f"images/{view.name}", "transform_matrix": pose.tolist(), **lens})
    (out / "transforms.json").write_text(json.dumps({"frames": frames}))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:3]))
