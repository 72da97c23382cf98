"""Features of photos and those that pairs of photos share, found by COLMAP through pycolmap.

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

from clsplat.errors import ClsplatError

SEED = 0
"""Of RANSAC and of the mapper. The same photos then give the same bytes on one machine, provided that matching and
mapper run on one thread and photos enter the database in their order."""

WORKERS_MAX = 8
"""Processes that match. Each has a copy of all features: some MB for each photo."""

PAIRS_MIN = 16
"""Pairs of photos that are worth a process of their own: they take about as long as it does to start."""

DEPENDENT = """
import os, signal, sys, threading
signal.signal(signal.SIGINT, signal.SIG_IGN)
threading.Thread(target=lambda: (sys.stdin.read(), os._exit(1)), daemon=True).start()
"""
"""How the programs below begin: they end when the process that started them does, however it does; Ctrl+C is left to
that process."""

FOLLOWER = """
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
"""Program that prints how many rows a table of some databases has, again and again. In a process of its own: locks on
files belong to processes, so that within one Python's SQLite and pycolmap's do not see each other's, and the memory
that they share was cut short under COLMAP (two of six runs on a busy machine ended with a bus error). Between
processes, and with the database in WAL mode, COLMAP never waits for this."""

WORKER = """
import json
sys.path[:] = json.loads(sys.argv[1])
from clsplat.dataset.sfm.matching import match_share
match_share(sys.argv[2], sys.argv[3], sys.argv[4] == "verbose")
"""
"""Program that runs `match_share` with the packages of the process that starts it."""


@contextmanager
def quiet(verbose: bool) -> Iterator[None]:
    """Without COLMAP's messages, unless `verbose`."""
    from pycolmap import logging

    before = logging.minloglevel
    logging.minloglevel = before if verbose else int(logging.ERROR)
    try:
        yield
    finally:
        logging.minloglevel = before


def is_sliver(width: int, height: int, edge_max: int) -> bool:
    """Whether nothing is left of a photo whose longer edge is reduced to `edge_max`: COLMAP dies of it."""
    return min(width, height) * edge_max < max(width, height)


def extract(database: Path, photos: Path, names: list[str], edge_max: int, masks: Path | None = None) -> None:
    """Put the features of photos into a database that has their cameras.

    Parameters
    ----------
    database : Path
        COLMAP's.
    photos : Path
        Folder of the photos.
    names : list of str
        Their names there and in the database.
    edge_max : int
        Longer edge, in pixels, that larger photos are reduced to.
    masks : Path, optional
        Folder with a mask ``NAME.png`` for each photo; features lie where it is not black.
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


def match(database: Path, pairs: list[tuple[int, int]], verbose: bool = False) -> None:
    """Put what pairs of photos share into the database that has their features.

    COLMAP's own threads would spoil it: with pycolmap 4.2.1, of 500 matchings of the same six pairs on two threads 20
    found other matches than the rest, once 67 in the place of 1776, and of 100 on one thread none. So each of several
    processes matches a share on one thread, in a database of its own. How many there are changes nothing in what they
    find.

    Parameters
    ----------
    database : Path
        COLMAP's. Nobody else may have it open.
    pairs : list of (int, int)
        The images' numbers there.
    verbose : bool
        Show COLMAP's own messages.

    Raises
    ------
    ClsplatError
        If a process fails.
    """
    import pycolmap

    if not pairs:
        return
    pycolmap.Database.open(database).close()  # its log enters the file, whoever had it open when it was written
    count = min(os.cpu_count() or 1, WORKERS_MAX, -(-len(pairs) // PAIRS_MIN))
    with TemporaryDirectory(prefix="matches_", dir=database.parent) as folder, ExitStack() as running:
        copies = [Path(folder) / f"{k}.db" for k in range(count)]
        for copy, share in zip(copies, np.array_split(np.array(pairs), count), strict=True):
            shutil.copyfile(database, copy)
            # By numbers: names in a list of pairs are separated by spaces.
            copy.with_suffix(".txt").write_text("".join(f"{i} {j}\n" for i, j in share.tolist()), encoding="utf-8")
        with _progress(copies, "two_view_geometries", len(pairs), "matches", "pair"):
            said = "verbose" if verbose else "quiet"
            workers = [
                running.enter_context(
                    _child(WORKER, json.dumps(sys.path), str(copy), str(copy.with_suffix(".txt")), said)
                )
                for copy in copies
            ]
            for worker in workers:
                if worker.wait() != 0:
                    raise ClsplatError(
                        "matches of photos: expected COLMAP to find them, found that its process ended with status "
                        f"{worker.returncode}; what it wrote is above, and -9 means that the memory did not suffice"
                    )
        with pycolmap.Database.open(database) as found:
            for copy in copies:
                with pycolmap.Database.open(copy) as part:
                    for number, matches in zip(*part.read_all_matches(), strict=True):
                        found.write_matches(*pycolmap.pair_id_to_image_pair(number), matches)
                    for number, geometry in zip(*part.read_two_view_geometries(), strict=True):
                        found.write_two_view_geometry(*pycolmap.pair_id_to_image_pair(number), geometry)


def match_share(database: str, listed: str, verbose: bool) -> None:
    """What a process of `match` does: match pairs on one thread.

    Parameters
    ----------
    database : str
        File with the features. Its photos are renamed to their numbers.
    listed : str
        File with a line ``NUMBER NUMBER`` for each pair.
    verbose : bool
        Show COLMAP's own messages.
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
def _child(
    program: str, *arguments: str, stdout: int | None = None, stderr: int | None = None
) -> Iterator[subprocess.Popen[str]]:
    """A process that runs one of the programs above; it does not outlive the context."""
    command = [sys.executable, "-I", "-c", DEPENDENT + program, *arguments]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=stdout, stderr=stderr, text=True) as child:
        try:
            yield child
        finally:
            child.kill()


@contextmanager
def _progress(databases: list[Path], table: str, total: int, label: str, unit: str) -> Iterator[None]:
    """Progress bar that counts the rows of a table of COLMAP's databases while COLMAP fills it and says nothing."""
    from tqdm import tqdm

    uris = [f"{database.resolve().as_uri()}?mode=ro" for database in databases]
    with (
        tqdm(total=total, desc=label, unit=unit, dynamic_ncols=True) as bar,
        _child(FOLLOWER, table, *uris, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as follower,
    ):

        def follow() -> None:
            for line in follower.stdout or ():
                bar.n = int(line)
                bar.refresh()

        thread = threading.Thread(target=follow, daemon=True)
        thread.start()
        try:
            yield
        finally:
            follower.kill()
            thread.join()
        bar.n = total
