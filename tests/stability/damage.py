"""Damage to files for tests: cut, flipped, spliced and overwritten bytes, other numbers, and changed parts of
JSON."""

import json
import re
import struct

import numpy as np
from hypothesis import strategies as st

EXTREMES = [
    *(struct.pack("<Q", n) for n in (0, 1, 255, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**53, 2**63 - 1, 2**64 - 1)),
    *(struct.pack("<I", n) for n in (0, 1, 3, 2**24, 2**31 - 1, 2**31, 2**32 - 1)),
    *(struct.pack("<f", x) for x in (np.nan, np.inf, -np.inf, 1e-45, 1e-38, 3e38, -3e38)),
    *(struct.pack("<d", x) for x in (np.nan, np.inf, -np.inf, 5e-324, 1e308, -1e308, 1e200)),
    *(bytes([n]) for n in (0, 1, 9, 10, 32, 34, 46, 47, 92, 127, 128, 255)),
]
NUMBERS = [
    *("0", "-1", "1", "2", "255", "256", "65536", "4294967296", "1000000000000", "-9223372036854775808", "9" * 400),
    *("nan", "NaN", "inf", "-Infinity", "1e308", "1e999", "-1e-320", "0x10", "1_0", "", " ", "\0", "x", "\n", "٣"),
]
JSON_VALUES = [
    *(None, True, False, 0, -1, 1, 0.5, 1e308, -1e308, 10**400, 2**63, float("nan"), float("inf"), 1e-320),
    *("", "x", "../x.png", "/etc/passwd", "a\0b.png", "C:\\x.png", "x" * 300, "\ud800", ".", "a/../../b.png"),
    *([], {}, [[]], [1, 2, 3], {"x": 1}, [[1, 2], [3]], ["x"]),
]
PLACES = st.integers(0, 2**20)
CUT = st.tuples(st.just("cut"), PLACES)
FLIP = st.tuples(st.just("flip"), PLACES, st.integers(0, 7))
PUT = st.tuples(st.just("put"), PLACES, st.sampled_from(EXTREMES))
SPLICE = st.tuples(st.just("splice"), PLACES, PLACES, PLACES)
NUMBER = st.tuples(st.just("number"), PLACES, st.sampled_from(NUMBERS))
BINARY = st.lists(st.one_of(CUT, FLIP, PUT, SPLICE), min_size=1, max_size=4)
TEXT = st.lists(st.one_of(NUMBER, NUMBER, CUT, FLIP, PUT, SPLICE), min_size=1, max_size=4)
ANY = st.one_of(BINARY, TEXT)


def damaged(content, changes):
    """Apply changes of the kinds above to bytes. Positions are taken modulo the length."""
    for kind, *at in changes:
        if not content:
            break
        place = at[0] % len(content)
        if kind == "cut":
            content = content[:place]
        elif kind == "flip":
            content = content[:place] + bytes([content[place] ^ 1 << at[1]]) + content[place + 1 :]
        elif kind == "put":
            content = content[:place] + at[1] + content[place + len(at[1]) :]
        elif kind == "splice":
            start = at[1] % len(content)
            content = content[:place] + content[start : start + at[2] % 64] + content[place:]
        elif kind == "number":
            if found := list(re.finditer(rb"[-+.\w]+", content)):
                match = found[at[0] % len(found)]
                content = content[: match.start()] + at[1].encode() + content[match.end() :]
    return content


def changed(value, place, new):
    """Replace a part of a JSON value, at any depth, by `new`, or remove it if `new` is Ellipsis."""
    paths = []

    def walk(part, path):
        paths.append(path)
        for key, inner in (
            part.items() if isinstance(part, dict) else enumerate(part) if isinstance(part, list) else ()
        ):
            walk(inner, (*path, key))

    walk(value, ())
    path = paths[place % len(paths)]
    if not path:
        return None if new is ... else new
    part = value = json.loads(json.dumps(value))
    for key in path[:-1]:
        part = part[key]
    if new is ...:
        del part[path[-1]]
    else:
        part[path[-1]] = new
    return value


JSON_CHANGES = st.lists(st.tuples(PLACES, st.sampled_from([*JSON_VALUES, ...])), min_size=1, max_size=3)
