"""Rules of the design: five files per stage, imports in one direction, short modules."""

import ast
import inspect
import re
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from clsplat import ops, reference
from clsplat.programs import kernel_folder
from clsplat.stages import FUNCTIONS

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "clsplat"
STAGES = sorted(p.stem for p in (PACKAGE / "ops").glob("*.py") if p.stem != "__init__")

# A unit is a package or a module of the top level. It imports only from the rows above its own.
LAYERS = """
    constants errors randomness display resuming host_memory fisheye
    ranges json_lines processors event_log
    config atomic
    camera gaussians field_stages run_log
    scene stages metrics panorama programs raster_arguments
    streaming
    buffers
    structs reference device
    ops inputs testing formats surface
    renderer field_selftest
    selftest
    render dataset demo raster_gradients fields
    rasterization pruning meshing
    training show
    evaluate blocks
    bench
    commands
    cli
    __main__
""".strip().splitlines()
LAYER = {unit: depth for depth, row in enumerate(LAYERS) for unit in row.split()}

# Units that must not be imported although LAYERS would allow it.
APART = {
    "reference": {"device", "structs", "ops", "scene", "metrics", "config"},  # the equations alone
    "dataset": {"gaussians", "ops", "render", "pruning", "training"},
    "formats": {"scene", "camera", "ops", "render", "pruning", "training"},
    # Nothing of the Gaussians knows of the fields, and nothing of the fields of Gaussians.
    "fields": {"gaussians", "renderer", "formats", "testing"},
    **{unit: {"fields"} for unit in ("rasterization", "pruning", "training", "show", "evaluate")},
    "demo": {"gaussians", "reference", "ops", "render", "training"},
}

# Kernels of `clsplat bench kernels`. They are not stages: they neither render nor train, and
# tests/bench/test_bench_kernels.py checks them. roof measures the device's limits, which no equation describes.
BENCH_KERNELS = {"roof"}

# The only units that may import certain third-party packages, which are optional or slow to import.
ONLY_IN = {
    "pyopencl": {"buffers", "device", "programs", "ops"},
    "pycolmap": {"dataset"},
    "viser": {"show"},
    "distributed": {"blocks"},
    "av": {"dataset", "show"},
    "pillow_heif": {"dataset"},
    "sqlite3": set(),  # with pycolmap in the same process it causes a bus error, see COUNT_ROWS in matching.py
}


def imports_of(path):
    """Dotted names of all imports of a module, including those in functions."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name}: relative import"
            # `from clsplat import x` imports the module clsplat.x.
            names |= {f"clsplat.{a.name}" for a in node.names} if node.module == "clsplat" else {str(node.module)}
    return names


def unit_of(path):
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


MODULES = [p for p in sorted(PACKAGE.rglob("*.py")) if p != PACKAGE / "__init__.py"]
EACH_MODULE = pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))


@pytest.mark.parametrize("stage", STAGES)
def test_five_files_for_each_stage(stage):
    assert (PACKAGE / "reference" / f"{stage}.py").is_file()
    assert (ROOT / "tests" / f"test_{stage}.py").is_file()
    assert (ROOT / "docs" / "stages" / f"{stage}.md").is_file()
    kernels = {p.name for p in kernel_folder().glob(f"{stage}*.cl")}
    assert kernels == {f"{stage}.cl"} or kernels >= {f"{stage}_cpu.cl", f"{stage}_gpu.cl"}


def test_no_kernel_without_a_stage():
    assert {p.stem.split("_")[0] for p in kernel_folder().glob("*.cl")} == set(STAGES) | BENCH_KERNELS


def test_ops_and_reference_have_all_stages(device):
    assert all(callable(getattr(module, name)) for module in (ops, reference) for name in FUNCTIONS)
    assert vars(ops.Launches(device)).keys() == set(FUNCTIONS)
    assert {getattr(ops, name).__module__.rsplit(".", 1)[1] for name in FUNCTIONS} == set(STAGES)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_ops_and_reference_have_the_same_signatures(name):
    device, *launched = inspect.signature(getattr(ops, name)).parameters.values()
    twin = inspect.signature(getattr(reference, name)).parameters.values()
    assert device.name == "device"
    assert [(p.name, p.kind, p.default) for p in launched] == [(p.name, p.kind, p.default) for p in twin]


@EACH_MODULE
def test_imports_go_one_way(path):
    unit = unit_of(path)
    assert unit in LAYER, f"give {unit} a place in LAYERS"
    for name in imports_of(path):
        root, *rest = name.split(".")
        if root == "clsplat" and rest and rest[0] != unit:
            assert LAYER[rest[0]] < LAYER[unit], f"{path.name} imports {name}"
            assert rest[0] not in APART.get(unit, ()), f"{path.name} imports {name}"
        elif root in ONLY_IN:
            assert unit in ONLY_IN[root], f"{path.name} imports {name}"


@pytest.mark.parametrize("path", [p for p in MODULES if unit_of(p) == "reference"], ids=lambda p: p.stem)
def test_twins_import_numpy_only(path):
    ours = {f"clsplat.{unit}" for unit in ("camera", "constants", "errors", "field_stages", "gaussians", "stages")}
    for name in imports_of(path):
        allowed = name in ours or name.startswith("clsplat.reference.") or name.split(".")[0] == "numpy"
        assert allowed or name.split(".")[0] in sys.stdlib_module_names, name


def test_no_two_modules_share_a_name():
    """Except for the two modules of a stage in ops and reference."""
    names = Counter(p.stem for p in MODULES if p.stem not in ("__init__", "__main__") and unit_of(p) != "reference")
    assert [name for name, count in names.items() if count > 1] == []
    shared = {p.stem for p in MODULES if unit_of(p) == "reference"} & set(names)
    assert shared - {"__init__"} == set(STAGES)


@pytest.mark.parametrize("path", [p for p in MODULES if p.stem == "__init__"], ids=lambda p: p.parent.name)
def test_every_package_says_what_belongs_there(path):
    docstring = " ".join((ast.get_docstring(ast.parse(path.read_text())) or "").split())
    assert "Belongs here:" in docstring and "Does not belong here:" in docstring


# Limits on shape: lines of a module; lines of code and parameters of a function.
LINES_MAX, CODE_MAX, PARAMETERS_MAX = 350, 60, 8
GSPLATS = {"rasterization"}  # its parameters are those of gsplat's function


def functions(path):
    """Functions and methods of a module, including nested ones."""
    return [
        n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, (ast.FunctionDef, ast.AsyncFunctionDef))
    ]


def code_lines(function):
    """Lines of a function without its docstring."""
    first = function.body[0]
    documented = ast.get_docstring(function) is not None
    return function.end_lineno - function.lineno + 1 - documented * (first.end_lineno - first.lineno + 1)


def parameters(function):
    """Number of parameters without self, cls and the device of a launch; *args and **kwargs count as one each."""
    a = function.args
    named = [arg.arg for arg in (*a.posonlyargs, *a.args, *a.kwonlyargs)]
    return (
        len(named) - (named[:1] in (["self"], ["cls"], ["device"])) + (a.vararg is not None) + (a.kwarg is not None)
    )


@EACH_MODULE
def test_modules_and_functions_are_short(path):
    assert len(path.read_text().splitlines()) <= LINES_MAX
    assert {f.name: code_lines(f) for f in functions(path) if code_lines(f) > CODE_MAX} == {}
    counts = {f.name: parameters(f) for f in functions(path) if f.name not in GSPLATS}
    assert {name: count for name, count in counts.items() if count > PARAMETERS_MAX} == {}


def test_import_is_light():
    heavy = {"pyopencl", "scipy", "matplotlib", "skimage", "pycolmap", "plyfile"}
    code = "import clsplat, sys; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert heavy & {name.split(".")[0] for name in loaded.stdout.split()} == set()


def test_no_path_of_a_machine():
    if not (ROOT / ".git").exists() or shutil.which("git") is None:
        pytest.skip("not a git checkout: the files of the project are not known")
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    pattern = re.compile(r"(?<![\w./:~-])/(?:home|root|Users|work|mnt|media|srv)/\w|\b[A-Z]:\\\w")
    found = []
    for name in filter(None, listed.split("\0")):
        try:
            text = (ROOT / name).read_text(encoding="utf-8")
        except (UnicodeDecodeError, FileNotFoundError):  # a picture, or a deleted file
            continue
        found += [f"{name}: {match[0]}" for match in pattern.finditer(text)]
    assert not found, found
