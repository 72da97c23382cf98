"""Measure structure from motion: time and completeness of each choice of pairs with both mappers.

    $ python tests/dataset/measure_sfm.py --scene bonsai --others fern castle_p30 -o sfm.json --every 2

The scene has photos with known poses (COLMAP's layout). Each photo gets a GPS position, as a receiver with an error
of `GPS_ERROR` would find it if the photos spanned `SPAN`. The vocabulary tree is built from the features of the other
scenes, since clsplat contains none. Times are processor times of this process and of those that it starts.
"""

import json
import resource
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
import pycolmap
import tyro
from PIL import ExifTags, Image
from tqdm import tqdm

from clsplat.config import SfmConfig
from clsplat.dataset.photos import list_photos, photo_folder
from clsplat.dataset.sfm.mapping import map_globally, map_incrementally
from clsplat.dataset.sfm.matching import extract, match, quiet
from clsplat.dataset.sfm.pairs import pairs_to_match

SPAN, GPS_ERROR = 200.0, 3.0
"""Largest extent of the photos' positions and standard error of a receiver in each direction, m."""

DEGREE = 111_195.0
"""Length of a degree of latitude, m."""

WORDS = 4096
"""Visual words of the tree, fewer than in COLMAP's trees (32 768 or more), as it is built from few photos."""

Matching = Literal["exhaustive", "sequential", "gps", "vocabulary"]
Mapper = Literal["incremental", "global"]
MAPPERS = {"incremental": map_incrementally, "global": map_globally}


def used() -> float:
    """Processor time of this process and of those that have ended, s."""
    return sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


@contextmanager
def timed(times: dict[str, float], name: str) -> Iterator[None]:
    """Store the processor time of what is done inside."""
    begin = used()
    yield
    times[name] = round(used() - begin, 1)


def exif(latitude: float, longitude: float) -> bytes:
    """EXIF data with a position in degrees, as a segment of a JPEG."""

    def parts(angle: float) -> tuple[float, float, float]:
        return float(int(angle)), float(int(angle * 60) % 60), round(angle * 3600 % 60, 5)

    data = Image.Exif()
    data[ExifTags.IFD.GPSInfo] = {
        ExifTags.GPS.GPSLatitudeRef: "N",
        ExifTags.GPS.GPSLatitude: parts(latitude),
        ExifTags.GPS.GPSLongitudeRef: "E",
        ExifTags.GPS.GPSLongitude: parts(longitude),
    }
    content = data.tobytes()
    return b"\xff\xe1" + (len(content) + 2).to_bytes(2, "big") + content


def ground(known: Any, names: list[str]) -> np.ndarray:
    """Positions (P, 2) of the photos on the ground, m: across the mean downward direction of the cameras."""
    images = {image.name: image.cam_from_world() for image in known.images.values()}
    centres = np.array([images[name].inverse().translation for name in names])
    down = np.mean([images[name].rotation.matrix()[1] for name in names], axis=0)
    plane = np.linalg.svd(down[None])[2][1:]
    flat = (centres - centres.mean(axis=0)) @ plane.T
    return flat * SPAN / np.ptp(flat, axis=0).max()


def with_positions(folder: Path, names: list[str], positions: np.ndarray, out: Path) -> None:
    """Copy JPEGs with a GPS position each."""
    noise = np.random.default_rng(0).normal(scale=GPS_ERROR, size=positions.shape)
    for name, (east, north) in zip(names, positions + noise, strict=True):
        photo = (folder / name).read_bytes()
        segment = exif(48 + north / DEGREE, 11 + east / DEGREE / np.cos(np.radians(48)))
        (out / name).write_bytes(photo[:2] + segment + photo[2:])


def features(database: Path, folder: Path, names: list[str]) -> None:
    """Make a database with the features of photos."""
    config = SfmConfig()
    pycolmap.Database.open(database).close()
    reader = pycolmap.ImageReaderOptions(camera_model=config.camera_model)
    pycolmap.import_images(
        database, folder, image_names=names, camera_mode=pycolmap.CameraMode.SINGLE, options=reader
    )
    extract(database, folder, names, config.max_image_size)
    pycolmap.Database.open(database).close()  # merges the write-ahead log into the file


def vocabulary(scenes: tuple[Path, ...], work: Path) -> Path:
    """Build a vocabulary tree from the features of scenes."""
    found: list[np.ndarray] = []
    for k, scene in enumerate(scenes):
        database, folder, names = work / f"words{k}.db", photo_folder(scene), list_photos(scene)
        features(database, folder, names)
        with pycolmap.Database.open(database) as opened:
            found += [opened.read_descriptors(image.image_id).data for image in opened.read_all_images()]
    kind = pycolmap.FeatureExtractorType.SIFT
    tree = pycolmap.VisualIndex.create(128, 64)
    options = pycolmap.VisualIndex.BuildOptions()
    options.num_visual_words, options.num_threads = WORDS, 1
    options.num_iterations, options.num_rounds = 20, 1  # COLMAP's 100 and 3 take half an hour
    tree.build(options, pycolmap.FeatureDescriptorsFloat(type=kind, data=np.concatenate(found).astype(np.float32)))
    tree.write(work / "words.bin")
    return work / "words.bin"


def compared(model: Any, known: Any) -> dict[str, float]:
    """Errors of the poses after a similarity: of positions relative to their span, and of rotations in degrees."""
    span = float(np.ptp([image.projection_center() for image in known.images.values()], axis=0).max())
    report = pycolmap.compare_reconstructions(
        model, known, alignment_error="proj_center", max_proj_center_error=0.01 * span
    )
    if report is None:
        return {}
    errors = report["errors"]
    return {
        "position error, median, % of span": 100 * float(np.median([e.proj_center_error for e in errors])) / span,
        "rotation error, median, degrees": float(np.median([e.rotation_error_deg for e in errors])),
    }


def main(
    scene: Path,
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    others: tuple[Path, ...] = (),
    every: int = 1,
    matchings: tuple[Matching, ...] = get_args(Matching),
    mappers: tuple[Mapper, ...] = get_args(Mapper),
) -> None:
    """Measure one scene, and write a row for each choice of pairs and each mapper."""
    source, names = photo_folder(scene), list_photos(scene)[::every]
    known = pycolmap.Reconstruction(scene / "sparse" / "0")
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as temporary, quiet(False):
        work = Path(temporary)
        folder = work / "photos"
        folder.mkdir()
        with_positions(source, names, ground(known, names), folder)
        times: dict[str, float] = {}
        with timed(times, "features, s"):
            features(work / "features.db", folder, names)
        tree = vocabulary(others, work) if "vocabulary" in matchings else None
        for matching in matchings:
            matched = work / f"{matching}.db"
            shutil.copyfile(work / "features.db", matched)
            config = SfmConfig(matching=matching, vocabulary=str(tree) if matching == "vocabulary" else None)
            with timed(times, "matches, s"):
                with pycolmap.Database.open(matched) as opened:
                    pairs = pairs_to_match(opened, folder, config)
                match(matched, pairs)
            for mapper in mappers:
                database, models = work / "run.db", work / "models"
                shutil.copyfile(matched, database)
                models.mkdir()
                with timed(times, "poses, s"):
                    made = MAPPERS[mapper](database, folder, models, len(names), config.min_registered)
                shutil.rmtree(models)
                model = max(made.values(), key=lambda model: model.num_reg_images(), default=None)
                rows.append(
                    {"photos": len(names), "matching": matching, "pairs": len(pairs), "mapper": mapper, **times}
                )
                if model is not None:
                    rows[-1] |= {
                        "registered": model.num_reg_images(),
                        "points": model.num_points3D(),
                        "reprojection error, px": round(model.compute_mean_reprojection_error(), 3),
                        **{key: round(error, 4) for key, error in compared(model, known).items()},
                    }
                tqdm.write(json.dumps(rows[-1]), file=sys.stderr)
                out.write_text("[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n")


if __name__ == "__main__":
    tyro.cli(main)
