"""Every kernel builds as its header says: with the defines that it names, and with no others."""

import re

import pyopencl as cl
import pytest

from clsplat.device import MODEL_CONSTANTS
from clsplat.programs import inline_includes, kernel_folder

# Defines that the header of a file documents, with allowed values. Files without defines are not listed.
DEFINES = {
    "noise": {"GATE_SLOPE": 100.0, "GATE_OPACITY": 0.005},
    "bin": {"TILE": 16, "GRADIENTS": 1, "LANES": 8},
    "composite_cpu": {"TILE": 8, "CHANNELS": 1, "LANES": 8, "RAYS": 2},
    "composite_gpu": {
        "TILE": 8,
        "CHANNELS": 1,
        "ITEMS": 32,
        "STAGED": 48,
        "BATCH": 16,
        "SEGMENT": 64,
        "RAYS": 1,
        "SUBGROUPS": 0,
    },
    "composite_sorted": {"TILE": 8, "CHANNELS": 1, "LANES": 8, "WINDOW": 2},
    "count": {"TILE": 16},
    "exposure": {"RESPONSE": 1},
    "filter": {"FILTER_VARIANCE": 0.2, "LENS": "FISHEYE"},
    "hashgrid": {"RESOLUTIONS": "4,8", "OFFSETS": "0,125,637"},
    "voxels": {"FEATURES": 28, "TV_EPS": 1e-9},
    "heads": {"EXPONENT_MAX": 15.0, "DENSITY_SHIFT": 1.0},
    "intervals": {"CONTRACTED": 1},
    "frustums": {"CONTRACTED": 1, "LANES": 8},
    "histograms": {"INTERLEVEL_EPS": 1e-7},
    "march": {"CONTRACTED": 1},
    "loss": {
        **{"SSIM_C1": 1e-4, "SSIM_C2": 1e-3, "SSIM_TAPS": "0.25,0.5,0.25", "RADIUS": 1},
        **{"LANES": 16, "VECTORS": 2, "GROUP": 32},
    },
    "mlp_cpu": {"WIDTHS": "32,64,16", "WIDEST": 64, "ROWS": 6},
    "mlp_gpu": {"TILE": 4},
    "absgrad": {"TILE": 16, "CHANNELS": 3, "BATCH": 16, "RAYS": 0, "SUBGROUPS": 0},
    "median": {"TILE": 16, "CHANNELS": 3, "RAYS": 1},
    "project": {
        **{"CHANNELS": 4, "ANTIALIASED": 1, "CAMERA_GRAD": 1, "GROUP": 32},
        **{"LENS": "FISHEYE", "RAYS": 0, "LANES": 1},
    },
    "removal_cpu": {"TILE": 8, "CHANNELS": 1, "LANES": 16, "RAYS": 2},
    "removal_gpu": {"TILE": 8, "CHANNELS": 1, "STOP": 1e-6, "BATCH": 16, "RAYS": 0, "SUBGROUPS": 0},
    "roof": {"WIDTH": 16, "HALVES": 1},
    "scan": {"GROUP": 32},
    "sort": {
        **{"KEY_BITS": 64, "DIGIT_BITS": 8, "GROUP": 32, "SEGMENT_BITS": 4, "SEGMENT_GROUP": 16},
        **{"BITONIC": 64, "BITONIC_GROUP": 32},
    },
    "sweep": {"RADIUS": 2, "VARIANCE_MIN": 1e-4, "LANES": 8, "ROWS": 16},
}
FORBIDDEN = [
    ("absgrad", "BATCH", 0),
    ("absgrad", "RAYS", 1),
    ("bin", "TILE", 0),
    ("bin", "GRADIENTS", 2),
    ("bin", "LANES", 4),
    ("composite_cpu", "TILE", 12),
    ("composite_cpu", "CHANNELS", 0),
    ("composite_cpu", "LANES", 4),
    ("composite_cpu", "RAYS", 3),
    ("composite_gpu", "TILE", 12),
    ("composite_gpu", "CHANNELS", 0),
    ("composite_gpu", "ITEMS", 48),
    ("composite_gpu", "STAGED", 0),
    ("composite_gpu", "BATCH", 0),
    ("composite_gpu", "SEGMENT", 0),
    ("composite_gpu", "SUBGROUPS", 2),
    ("composite_sorted", "TILE", 12),
    ("composite_sorted", "CHANNELS", 0),
    ("composite_sorted", "WINDOW", 0),
    ("count", "TILE", 0),
    ("exposure", "RESPONSE", 2),
    ("filter", "LENS", 5),
    ("loss", "RADIUS", 0),
    ("loss", "LANES", 8),
    ("loss", "VECTORS", 0),
    ("loss", "GROUP", 0),
    ("median", "TILE", 0),
    ("median", "CHANNELS", 0),
    ("median", "RAYS", 3),
    ("intervals", "CONTRACTED", 2),
    ("frustums", "CONTRACTED", 2),
    ("frustums", "LANES", 4),
    ("march", "CONTRACTED", 2),
    ("voxels", "FEATURES", 0),
    ("mlp_cpu", "WIDEST", 2064),
    ("mlp_cpu", "ROWS", 8),
    ("mlp_gpu", "TILE", 3),
    ("project", "CHANNELS", 5),
    ("project", "ANTIALIASED", 2),
    ("project", "CAMERA_GRAD", 2),
    ("project", "LENS", "MIRROR"),
    ("project", "LENS", "EQUIRECTANGULAR"),
    ("project", "RAYS", 2),
    ("project", "GROUP", 0),
    ("removal_cpu", "TILE", 12),
    ("removal_cpu", "CHANNELS", 0),
    ("removal_cpu", "LANES", 32),
    ("removal_gpu", "TILE", 12),
    ("removal_gpu", "CHANNELS", 0),
    ("removal_gpu", "BATCH", 0),
    ("removal_gpu", "SUBGROUPS", 2),
    ("roof", "WIDTH", 3),
    ("project", "LANES", 4),
    ("project", "LANES", 8),
    ("roof", "HALVES", 2),
    ("scan", "GROUP", 0),
    ("sort", "KEY_BITS", 16),
    ("sort", "DIGIT_BITS", 17),
    ("sort", "DIGIT_BITS", 11),
    ("sort", "GROUP", 0),
    ("sort", "SEGMENT_BITS", 12),
    ("sort", "SEGMENT_GROUP", 0),
    ("sort", "BITONIC", 100),
    ("sort", "BITONIC_GROUP", 64),
    ("sweep", "LANES", 4),
    ("sweep", "RADIUS", 8),
]
EACH_KERNEL = pytest.mark.parametrize("name", sorted(p.stem for p in kernel_folder().glob("*.cl")))


@EACH_KERNEL
def test_kernels_build_as_documented(any_device, name):
    header = (kernel_folder() / f"{name}.cl").read_text().split("#include")[0]
    assert set(re.findall(r"-D([A-Z0-9_]+)", header)) == set(DEFINES.get(name, {}))
    assert any_device.program(name, DEFINES.get(name, {})).all_kernels()


@EACH_KERNEL
def test_a_missing_define_is_a_sentence(device, name):
    documented = DEFINES.get(name, {})
    for missing in documented:
        defines = {key: value for key, value in documented.items() if key != missing}
        with pytest.raises(cl.RuntimeError, match=f"error: .*-D{missing}\\b"):
            device.program(name, defines)


@pytest.mark.parametrize(("name", "define", "value"), FORBIDDEN)
def test_a_forbidden_define_is_a_sentence(device, name, define, value):
    with pytest.raises(cl.RuntimeError, match=f"error: .*-D{define}\\b"):
        device.program(name, DEFINES[name] | {define: value})


@pytest.mark.parametrize("path", sorted(kernel_folder().iterdir()), ids=lambda path: path.name)
def test_no_kernel_multiplies_by_zero_to_find_what_is_not_finite(path):
    """Mesa takes 0 * x for 0; cl/common.h has FINITE."""
    code = re.sub(r"//.*", "", path.read_text())
    assert not re.search(r"\b0 \*[^;]*==", code)


def test_missing_constants_are_a_sentence(device):
    source = inline_includes("scan.cl", kernel_folder())
    constants = [f"-D{name}=1" for name in MODEL_CONSTANTS]
    for k in range(len(constants)):
        with pytest.raises(cl.RuntimeError, match=r"the constants of .* must be passed as -D"):
            cl.Program(device.context, source).build(["-DGROUP=1", *constants[:k], *constants[k + 1 :]])
