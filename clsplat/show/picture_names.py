"""Names of the pictures that are written for photos."""

from collections.abc import Iterable

from clsplat.atomic import shortened


def distinct_stems(stems: Iterable[str], endings: tuple[str, ...] = ("",)) -> list[str]:
    """Make stems of files differ, by underscores, so that no two of their files have a name, in any case of letters.

    Parameters
    ----------
    stems : iterable of str
        Paths without suffix, with forward slashes.
    endings : tuple of str
        Endings of the files of each stem, before their common suffix.
    """
    result = []
    taken: set[str] = set()
    for stem in stems:
        folder, slash, last = stem.rpartition("/")
        stem = folder + slash + shortened(last)
        while not taken.isdisjoint(files := {f"{stem}{ending}".casefold() for ending in endings}):
            stem += "_"
        taken |= files
        result.append(stem)
    return result
