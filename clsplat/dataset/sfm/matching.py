"""Features of photos and matches between pairs of photos, computed by COLMAP through pycolmap.

SIFT on the CPU, approximate nearest neighbours, two-view geometry by RANSAC: Schoenberger and Frahm 2016,
doi:10.1109/CVPR.2016.445.
"""

import json
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from clsplat.dataset.lenses import handle_signals
from clsplat.dataset.sfm.processes import child, how_it_ended
from clsplat.errors import ClsplatError, InputError

SEED = 0
"""Seed of RANSAC and of COLMAP's mapper. With it, the same photos give the same bytes on one machine, provided that
matching and mapper run on one thread each and photos enter the database in order."""

WORKERS_MAX = 8
"""Largest number of matching processes. Each holds a copy of all features: some MB per photo."""

PAIRS_MIN = 16
"""Smallest number of pairs of photos per process. Matching them takes about as long as starting a process."""

COUNT_ROWS = """
import sqlite3, time
while True:
    time.sleep(0.5)
    try:
        count = 0
        for database in sys.argv[2:]:
            rows = sqlite3.connect(database, uri=True)
            count += rows.execute(f"SELECT COUNT(*) FROM {sys.argv[1]}").fetchone()[0]
            rows.close()
        print(count, flush=True)
    except sqlite3.Error:
        pass
"""
"""Program that repeatedly prints the number of rows of a table, summed over databases.

It must run in a separate process. File locks belong to processes: within one process, Python's SQLite and
pycolmap's do not see each other's locks, and the memory that they share can be truncated while COLMAP uses it, which
ends in a bus error. In another process, and with the database in WAL mode, it never makes COLMAP wait."""

MATCH_SHARE = """
import json
sys.path[:] = json.loads(sys.argv[1])
from clsplat.dataset.sfm.matching import match_share
try:
    match_share(sys.argv[2], sys.argv[3], sys.argv[4] == "verbose")
except Exception as error:  # without a traceback: COLMAP's errors are of many kinds
    sys.exit(f"COLMAP: {error!r}")
"""
"""Program that runs `match_share` with the module search path of the process that started it."""


@contextmanager
def quiet(verbose: bool) -> Iterator[None]:
    """Suppress COLMAP's messages, unless `verbose`, and the stack trace that it prints when a signal ends it."""
    from pycolmap import logging

    handle_signals()
    before = logging.minloglevel
    logging.minloglevel = before if verbose else int(logging.ERROR)
    try:
        yield
    finally:
        logging.minloglevel = before


def is_sliver(width: int, height: int, edge_max: int) -> bool:
    """Whether a photo is so elongated that its shorter edge vanishes when its longer edge is reduced to `edge_max`.

    COLMAP crashes on such photos.
    """
    return min(width, height) * edge_max < max(width, height)


def extract(database: Path, photos: Path, names: list[str], edge_max: int, masks: Path | None = None) -> None:
    """Detect the features of photos and add them to a COLMAP database that holds the cameras.

    Parameters
    ----------
    database : Path
        COLMAP database.
    photos : Path
        Folder of the photos.
    names : list of str
        Names of the photos in that folder and in the database.
    edge_max : int
        Longer edge, in pixels, to which larger photos are reduced.
    masks : Path, optional
        Folder with a mask ``NAME.png`` for each photo. No features are detected where it is black.

    Raises
    ------
    InputError
        If COLMAP cannot read a photo.
    """
    import pycolmap

    reader = pycolmap.ImageReaderOptions()
    if masks is not None:
        reader.mask_path = masks
    with _progress([database], "keypoints", len(names), "features", "photo"):
        pycolmap.set_random_seed(SEED)
        pycolmap.extract_features(
            database,
            photos,
            image_names=names,
            reader_options=reader,
            extraction_options=pycolmap.FeatureExtractionOptions(max_image_size=edge_max, use_gpu=False),
            device=pycolmap.Device.cpu,
        )
    with pycolmap.Database.open(database) as opened:
        read = [image.name for image in opened.read_all_images() if opened.exists_keypoints(image.image_id)]
    demand(photos, names, read)


def demand(photos: Path, names: list[str], read: list[str]) -> None:
    """Raise an InputError if COLMAP has left out a photo: it continues without those that it cannot read."""
    if missing := sorted(set(names) - set(read)):
        raise InputError(
            f"cannot read {photos / missing[0]}: COLMAP could not read {len(missing)} of {len(names)} photos, which "
            "could be read shortly before; check the disk, and try again"
        )


def match(database: Path, pairs: list[tuple[int, int]], verbose: bool = False) -> None:
    """Match the features of pairs of photos and add the matches to the COLMAP database that holds the features.

    With several threads, COLMAP's matches differ from run to run (pycolmap 4.2.1; docs/howto/photos.md). Therefore
    several processes share the pairs; each matches on one thread in a database of its own. The result does not depend
    on the number of processes.

    Parameters
    ----------
    database : Path
        COLMAP database. It must not be open elsewhere.
    pairs : list of (int, int)
        Numbers of the images in the database.
    verbose : bool
        Whether to show COLMAP's own messages.

    Raises
    ------
    ClsplatError
        If a process fails.
    """
    import pycolmap

    if not pairs:
        return
    pycolmap.Database.open(database).close()  # merges the write-ahead log into the file, which is copied below
    count = min(os.cpu_count() or 1, WORKERS_MAX, -(-len(pairs) // PAIRS_MIN))
    parts = TemporaryDirectory(prefix="matches_", dir=database.parent, ignore_cleanup_errors=True)
    with parts as folder, ExitStack() as running:
        copies = [Path(folder) / f"{k}.db" for k in range(count)]
        for copy, share in zip(copies, np.array_split(np.array(pairs), count), strict=True):
            shutil.copyfile(database, copy)
            # Numbers instead of names: the list of pairs separates names by spaces.
            copy.with_suffix(".txt").write_text("".join(f"{i} {j}\n" for i, j in share.tolist()), encoding="utf-8")
        with _progress(copies, "two_view_geometries", len(pairs), "matches", "pair"):
            loudness = "verbose" if verbose else "quiet"
            workers = [
                running.enter_context(
                    child(MATCH_SHARE, json.dumps(sys.path), str(copy), str(copy.with_suffix(".txt")), loudness)
                )
                for copy in copies
            ]
            for worker in workers:
                if worker.wait() != 0:
                    raise ClsplatError(f"cannot match photos: {how_it_ended(worker.returncode)}")
        with pycolmap.Database.open(database) as found:
            for copy in copies:
                with pycolmap.Database.open(copy) as part:
                    for number, matches in zip(*part.read_all_matches(), strict=True):
                        found.write_matches(*pycolmap.pair_id_to_image_pair(number), matches)
                    for number, geometry in zip(*part.read_two_view_geometries(), strict=True):
                        found.write_two_view_geometry(*pycolmap.pair_id_to_image_pair(number), geometry)


def match_share(database: str, listed: str, verbose: bool) -> None:
    """Match a list of pairs on one thread; run by each process of `match`.

    Parameters
    ----------
    database : str
        Database with the features. Its photos are renamed to their numbers.
    listed : str
        Text file with a line ``NUMBER NUMBER`` for each pair.
    verbose : bool
        Whether to show COLMAP's own messages.
    """
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        for image in opened.read_all_images():
            image.name = str(image.image_id)
            opened.update_image(image)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    pycolmap.set_random_seed(SEED)
    with quiet(verbose):
        pycolmap.match_image_pairs(
            database,
            matching_options=pycolmap.FeatureMatchingOptions(num_threads=1),
            pairing_options=pycolmap.ImportedPairingOptions(match_list_path=listed),
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )


@contextmanager
def _progress(databases: list[Path], table: str, total: int, label: str, unit: str) -> Iterator[None]:
    """Show a progress bar with the number of rows in a table of COLMAP databases; COLMAP reports no progress."""
    from tqdm import tqdm

    uris = [f"{database.resolve().as_uri()}?mode=ro" for database in databases]
    with (
        tqdm(total=total, desc=label, unit=unit, dynamic_ncols=True) as bar,
        child(COUNT_ROWS, table, *uris, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as counter,
    ):

        def follow() -> None:
            for line in counter.stdout or ():
                bar.n = int(line)
                bar.refresh()

        thread = threading.Thread(target=follow, daemon=True)
        thread.start()
        try:
            yield
        finally:
            counter.kill()
            thread.join()
        bar.n = total
