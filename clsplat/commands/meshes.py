"""The command `mesh`."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from clsplat.commands.console import Dataset, DeviceName, Out, SceneOrRun, moved, open_device, say
from clsplat.commands.options import COORDINATE_MAX, CameraOptions, DrawOptions
from clsplat.commands.run_folders import dataset_of, scene_file, with_run
from clsplat.errors import InputError
from clsplat.ranges import within


@dataclass(frozen=True)
class Mesh:
    """Make a triangle mesh of a scene, with colours, from the depths that the dataset's cameras see."""

    scene: SceneOrRun
    """File of Gaussians, or the folder of a run."""
    out: Out
    """The .ply file to write."""
    data: Dataset = None
    """Dataset, as for `train`, whose training photos' cameras see the scene. Default: the dataset of the run."""
    resolution: Annotated[int, within(least=8, most=2048)] = 256
    """Voxels along the longest edge of the box. Memory and time grow with the cube of it."""
    box: Annotated[tuple[float, ...], within(least=-COORDINATE_MAX, most=COORDINATE_MAX)] = ()
    """Smallest x, y and z and largest x, y and z of the mesh, in world coordinates: six numbers. Default: the box of
    all surface points that the cameras see, except for the outermost fiftieth on each side."""
    device: DeviceName = None
    """Part of the name of the platform or device."""
    data_config: Annotated[CameraOptions, tyro.conf.arg(name="")] = field(default_factory=CameraOptions)
    render: Annotated[DrawOptions, tyro.conf.arg(name="")] = field(default_factory=DrawOptions)

    def base(self) -> "Mesh | None":
        """The command with the settings of its run, before flags override them; None if it has none."""
        return with_run(self)

    def run(self) -> None:
        """Run the command."""
        from tqdm import tqdm

        from clsplat.dataset import load_scene_with_points
        from clsplat.formats import load_gaussians
        from clsplat.meshing import make_mesh, save_mesh
        from clsplat.renderer import Renderer

        if self.out.suffix.lower() != ".ply":
            raise InputError(f"{self.out}: expected the suffix .ply, found {self.out.suffix or 'none'}")
        if len(self.box) not in (0, 6):
            raise InputError(f"--box: expected six numbers, found {len(self.box)}")
        check_replaceable(self.out)
        data = dataset_of("mesh", self.data)
        gaussians, mode, offset = load_gaussians(scene_file(self.scene))
        device = open_device(self.device)
        scene = load_scene_with_points(data, self.data_config, self.data_config.triangulate)
        gaussians = moved(gaussians, offset - scene.offset)
        box = (self.box[:3] - scene.offset, self.box[3:] - scene.offset) if self.box else None
        cameras = [view.camera for view in scene.train]
        mesh = make_mesh(
            gaussians,
            tqdm(cameras, "depths", unit="view", leave=False),
            Renderer(device, replace(self.render, mode=mode)),
            resolution=self.resolution,
            box=box,
        )
        save_mesh(self.out, mesh._replace(vertices=mesh.vertices + scene.offset))
        say(f"{self.out}: {len(mesh.vertices)} vertices, {len(mesh.faces)} triangles")


def check_replaceable(out: Path) -> None:
    """Raise an InputError if a PLY exists that is no mesh, such as a trained scene, which has the same suffix."""
    from clsplat.formats.ply_container import read_header
    from clsplat.formats.validity import reading

    if not out.is_file():
        return
    with reading(out), out.open("rb") as file:
        elements = read_header(out, file).elements
    if "face" not in elements:
        raise InputError(
            f"{out}: expected a new file or a mesh to replace, found a PLY without triangles, such as a scene; "
            "choose another name with -o"
        )
