"""Fuzz the readers of clsplat, guided by coverage: ``make fuzz MINUTES=15``. Needs the extra `fuzz`.

Each reader runs in a process of its own, from the files in ``corpus/READER``. Inputs that reach new code are kept and
changed further (libFuzzer); changes are those of `mutations`. Whatever fails is made smaller and saved in
``build/fuzz/READER``. With ``--runs`` instead of ``--minutes``, the same seed draws the same cases.
"""

import argparse
import hashlib
import json
import os
import random
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path

from mutations import mutated, packed

TIMEOUT = 120
"""Seconds after which a case counts as a hang. The slowest cases take a few; making a finding smaller takes more."""

RSS_MAX = 4096
"""Memory of the process, MiB, that counts as a finding: a case may decode Pillow's largest image."""

INPUT_MAX = 2**17
"""Largest case, bytes; the files of the corpus have a few kB."""

SMALLER_TRIES = 200
"""Cases that are tried to make a finding smaller."""


FRESH = 0.5
"""Fraction of the cases that are changes of a file in the corpus, rather than of any input that reached new code."""

MEASURED_EVERY = 8
"""Cases per case whose memory is measured."""


def smaller(content, fails):
    """Remove parts of a case as long as it fails in the same way: members of a ZIP, then ranges of bytes."""
    import io
    import zipfile

    members = None
    if content.startswith(b"PK"):
        try:
            with zipfile.ZipFile(io.BytesIO(content)) as archive:
                members = {info.filename: archive.read(info) for info in archive.infolist()}
        except Exception:  # damaged itself
            members = None
    if members and fails(packed(members)):
        for name in [*members]:
            rest = {other: part for other, part in members.items() if other != name}
            if fails(packed(rest)):
                members = rest
        return packed(members)
    tries, step = 0, max(1, len(content) // 2)
    while tries < SMALLER_TRIES and step:
        at = 0
        while at < len(content) and tries < SMALLER_TRIES:
            shorter = content[:at] + content[at + step :]
            tries += 1
            if fails(shorter):
                content = shorter
            else:
                at += step
        step //= 2
    return content


def child(options):
    """Fuzz one reader until the time or the number of cases is over; never returns."""
    import atheris

    with atheris.instrument_imports(include=["clsplat"]):
        import readers

    folder = Path(tempfile.mkdtemp())
    saved = options.out / options.reader
    counts = {"cases": 0, "read": 0, "refused": 0, "none": 0, "findings": {}}
    starts = [path.read_bytes() for path in sorted((readers.CORPUS / options.reader).iterdir())]
    end = time.monotonic() + options.seconds if options.seconds else None

    def outcome(content):
        try:
            measured = counts["cases"] % MEASURED_EVERY == 0
            return readers.attempt(folder, options.reader, content, measured), None
        except Exception as error:
            return readers.key_of(error), error

    def one(content):
        result, error = outcome(content)
        counts["cases"] += 1
        if error is None:
            counts[result] += 1
        elif result not in counts["findings"]:
            text = "".join(traceback.format_exception(error))
            counts["findings"][result] = ""  # is being made smaller: a hang leaves the case as it is
            (saved / "found-whole").write_bytes(content)
            least = smaller(content, lambda c: outcome(c)[0] == result)
            (saved / "found-whole").unlink()
            name = f"found-{hashlib.sha256(least).hexdigest()[:10]}"
            counts["findings"][result] = name
            (saved / name).write_bytes(least)
            (saved / f"{name}.txt").write_text(f"{result}\n{text}")
            print(f"{options.reader}: {result}: {saved / name}", flush=True)
        if counts["cases"] == options.runs or (end and time.monotonic() > end):
            (saved / "counts.json").write_text(json.dumps(counts))
            sys.stdout.flush()
            os._exit(0)

    def changed(content, most, seed):
        rng = random.Random(seed)
        # Most inputs that reach new code are refused, and so are changes of them: half of the cases start anew.
        result = mutated(rng.choice(starts) if rng.random() < FRESH else content, rng)
        return result if len(result) <= most else content[:most]

    flags = [f"-seed={options.seed}", f"-timeout={TIMEOUT}", f"-rss_limit_mb={RSS_MAX}", f"-max_len={INPUT_MAX}"]
    flags += ["-verbosity=0", "-print_final_stats=0", f"-artifact_prefix={saved}/", "-malloc_limit_mb=0"]
    folders = [str(saved / "new"), str(readers.CORPUS / options.reader)]
    atheris.Setup([sys.argv[0], *flags, *folders], one, custom_mutator=changed)
    atheris.Fuzz()


def covered(reader, files):
    """Number of lines of clsplat that run while files are read."""
    import readers

    with tempfile.TemporaryDirectory() as folder:

        def work():
            for file in files:
                try:
                    readers.attempt(Path(folder), reader, file.read_bytes())
                except Exception:  # a finding, which is reported elsewhere
                    continue

        return len(readers.covered_lines(work))


def main():
    """Run all readers, one after the other, and print what they covered and found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("readers", nargs="*", help="readers; default: all")
    parser.add_argument("--minutes", type=float, default=15, help="for all readers together")
    parser.add_argument("--runs", type=int, help="cases of each reader, instead of --minutes")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("build/fuzz"))
    parser.add_argument("--reader", help=argparse.SUPPRESS)
    parser.add_argument("--seconds", type=float, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.reader:
        child(options)
    import readers

    unknown = set(options.readers) - readers.READERS.keys()
    if unknown:
        parser.error(f"expected readers among {', '.join(readers.READERS)}, found {', '.join(unknown)}")
    chosen = options.readers or [*readers.READERS]
    failed = False
    for reader in chosen:
        saved = options.out / reader
        (saved / "new").mkdir(parents=True, exist_ok=True)
        for old in (saved / "counts.json", *saved.glob("new/*"), *saved.glob("*-*")):
            old.unlink(missing_ok=True)
        length = ["--runs", str(options.runs)] if options.runs else []
        length += [] if options.runs else ["--seconds", str(60 * options.minutes / len(chosen))]
        command = [sys.executable, __file__, "--reader", reader, "--seed", str(options.seed), *length]
        with (saved / "log.txt").open("w") as log:
            code = subprocess.run([*command, "--out", options.out], stdout=log, stderr=log, check=False).returncode
        counts = json.loads((saved / "counts.json").read_text()) if (saved / "counts.json").exists() else {}
        seeds = sorted((readers.CORPUS / reader).iterdir())
        lines = [covered(reader, files) for files in (seeds, [*seeds, *sorted((saved / "new").iterdir())])]
        print(
            f"{reader}: {counts.get('cases', '?')} cases, {counts.get('read', '?')} read, "
            f"{counts.get('refused', '?')} refused; {lines[0]} lines covered by the corpus, {lines[1]} in the end; "
            f"{len(counts.get('findings', {}))} findings",
            flush=True,
        )
        for key, name in counts.get("findings", {}).items():
            print(f"  {key}: {saved / name}", flush=True)
        if code:
            print(f"  ended with code {code}: hang, crash or memory; see {saved / 'log.txt'}", flush=True)
        failed |= bool(code or counts.get("findings"))
    sys.exit(failed)


if __name__ == "__main__":
    main()
