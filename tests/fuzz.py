"""Feed broken files to the readers: ``python -m tests.fuzz [--seconds 60] [READER ...]``.

What a reader is given is a good file with a few of its bytes changed, cut, repeated, or replaced by
what breaks programs. It may return something sound or raise InputError, within five seconds.
Anything else is a fault: the file is kept in ``out/fuzz``, and the exit code is 1.

With ``--guided`` the changes follow the coverage of the code (``pip install atheris``): it runs
until it is stopped, on one reader.
"""

import argparse
import csv
import hashlib
import json
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

if "--guided" in sys.argv:  # what is imported here first is followed
    import atheris  # pyright: ignore[reportMissingImports]

    with atheris.instrument_imports(include=["jaxdeform"]):
        import jaxdeform._mesh.files

import jaxdeform as jd
from jaxdeform._apps.arguments import read_parts
from jaxdeform._apps.batch.manifest import read_manifest

CASES = Path(__file__).with_name("cases")
LIMIT = 5.0
ODD = (
    *(b"nan", b"inf", b"-1", b"0", b"1e999", b"99999999999999999999", b"4294967295", b"\0"),
    *(b"\xff\xfe", b"\xef\xbb\xbf", b"\r", b"\n", b"\\\n", b"/", b"//", b"#", b'"', b"," * 50),
    *(
        b"[" * 3000,
        b"(" * 3000,
        b"{" * 300,
        b"not " * 500,
        "Ü".encode(),
        b"\x1f\x8b",
        b"end_header",
    ),
)


class Reader(NamedTuple):
    """A function of one file, and good files for it."""

    read: Callable[[Path], object]
    name: str
    """Of the file."""
    seeds: list[bytes]


def strip() -> jd.Mesh:
    points = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.5], [0, 2, 0], [1, 2, 0]]
    return jd.Mesh(np.asarray(points, float), [[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4]])


def readers(folder: Path) -> dict[str, Reader]:
    """Return the readers by name. The folder holds what their files name."""
    mesh, found = strip(), {}
    for suffix in ("obj", "off", "ply", "stl"):
        jd.save_mesh(folder / f"seed.{suffix}", mesh)
        seeds = [(folder / f"seed.{suffix}").read_bytes()]
        seeds += [path.read_bytes() for path in sorted(CASES.glob(f"*.{suffix}"))]
        found[suffix] = Reader(_sound_mesh, f"broken.{suffix}", seeds)
    jd.save_mesh(folder / "seed.ply", mesh, rigidity=np.arange(6.0))
    rigid = (folder / "seed.ply").read_bytes()
    found["rigidity"] = Reader(jd.load_rigidity, "broken.ply", [rigid])
    groups = [
        {"where": "y < 0.5", "rotation": {"axis": [0, 0, 1], "degrees": 30, "center": [0, 0, 0]}},
        {"vertices": [4, 5], "targets": [[0, 2, 1], [1, 2, 1]]},
    ]
    handles = json.dumps({"handles": groups}).encode()
    found["handles"] = Reader(lambda path: jd.load_handles(path, mesh), "broken.json", [handles])
    survey = b"0\n0\n1\n1\n2\n2\n"
    (folder / "broken.def").write_text("1 0 0 0\n0 1 0 0\n0 0 1 1\n0 0 0 1\n")
    found["survey"] = Reader(lambda path: jd.load_handles(path, mesh), "broken.sel", [survey])
    parts = [b"0\n0\n1\n1\n0\n0\n"]
    found["parts"] = Reader(lambda path: read_parts(path, mesh), "broken.txt", parts)
    found["expression"] = Reader(
        lambda path: jd.select.where(mesh, path.read_bytes().decode(errors="replace")),
        "broken.expression",
        [b"0 < y <= 1.5 and not (x*x + z < 2 or v > -0.5e-3)", b"u / 2 != w + 1"],
    )
    job = {"job": "a", "mesh": "seed.off", "fix": "y < 0.5", "move": "y > 1.5", "rotate": "z 30"}
    job |= {"translate": "0 0 1", "rigidity": 2, "stiff": "x > 0.5: 3", "rings": 2, "frames": 3}
    found["jobs"] = Reader(read_manifest, "broken.jsonl", [json.dumps(job).encode()])
    with (folder / "seed.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, job)
        table.writeheader()
        table.writerows([job, job | {"job": "b"}])
    found["table"] = Reader(read_manifest, "broken.csv", [(folder / "seed.csv").read_bytes()])
    return found


def _sound_mesh(path: Path) -> None:
    """Read a mesh; what is returned is sound, and can be written and read again."""
    mesh = jd.load_mesh(path)
    assert np.isfinite(mesh.vertices).all()
    assert mesh.faces.min() >= 0
    assert mesh.faces.max() < mesh.n_vertices
    again = path.with_name(f"again{path.suffix}")
    jd.save_mesh(again, mesh, vertices=mesh.vertices)
    np.testing.assert_array_equal(jd.load_mesh(again).faces, mesh.faces)


def broken(rng: np.random.Generator, seeds: list[bytes]) -> bytes:
    """Return a seed with one to six changes."""
    data = bytearray(seeds[rng.integers(len(seeds))])
    for _ in range(rng.integers(1, 7)):
        at, end = sorted(rng.integers(0, len(data) + 1, 2).tolist())
        kind = rng.integers(6)
        if kind == 0 and data:
            data[min(at, len(data) - 1)] = int(rng.integers(256))
        elif kind == 1:
            data[at:at] = ODD[rng.integers(len(ODD))]
        elif kind == 2:
            del data[at : min(end, at + int(rng.integers(1, 20)))]
        elif kind == 3:
            data[at:at] = data[at : min(end, at + 200)]
        elif kind == 4:
            data[at : at + int(rng.integers(1, 5))] = ODD[rng.integers(len(ODD))]
        elif rng.random() < 0.3:
            del data[at:]
    return bytes(data)


@contextmanager
def _limited() -> Iterator[None]:
    """Raise TimeoutError after a while, where the system has alarms."""

    def ring(*_) -> None:
        raise TimeoutError(f"took more than {LIMIT} s")

    if not hasattr(signal, "setitimer"):
        yield
        return
    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, LIMIT)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def fault_of(reader: Reader, data: bytes, folder: Path) -> str | None:
    """Return what is wrong with how a reader takes these bytes, or None."""
    path = folder / reader.name
    path.write_bytes(data)
    try:
        with warnings.catch_warnings(), _limited():
            warnings.simplefilter("error")  # NumPy's words are none for a user
            warnings.simplefilter("ignore", UserWarning)
            reader.read(path)
    except jd.InputError as error:
        if len(str(error)) > 2000:
            return f"a message of {len(str(error))} signs"
    except (Exception, RecursionError) as error:
        return f"{type(error).__name__}: {error}"
    return None


def run(names: list[str], seed: int, count: int | None, seconds: float) -> list[str]:
    """Feed broken files to readers in turn, so many to each or for so long; return the faults."""
    rng, faults, fed = np.random.default_rng(seed), [], 0
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        table = {k: v for k, v in readers(folder).items() if k in names or not names}
        end = time.monotonic() + seconds
        while (fed < count) if count is not None else (time.monotonic() < end):
            for name, reader in table.items():
                data = broken(rng, reader.seeds)
                fault = fault_of(reader, data, folder)
                if fault:
                    faults.append(f"{name}: {fault[:300]} ({_kept(reader, data)})")
            fed += 1
    print(f"{fed * len(table)} files, {len(faults)} faults")
    return faults


def _kept(reader: Reader, data: bytes) -> Path:
    place = Path("out", "fuzz")
    place.mkdir(parents=True, exist_ok=True)
    path = place / f"{hashlib.sha256(data).hexdigest()[:12]}-{reader.name}"
    path.write_bytes(data)
    return path


def guided(name: str) -> None:
    """Let atheris choose the changes; it stops at the first fault."""
    folder = Path(tempfile.mkdtemp())
    reader = readers(folder)[name]
    corpus = folder / "corpus"
    corpus.mkdir()
    for k, seed in enumerate(reader.seeds):
        (corpus / str(k)).write_bytes(seed)

    def one(data: bytes) -> None:
        fault = fault_of(reader, data, folder)
        if fault:
            raise RuntimeError(f"{fault} ({_kept(reader, data)})")

    atheris.Setup([sys.argv[0], str(corpus)], one)
    atheris.Fuzz()


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("reader", nargs="*")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--guided", action="store_true")
    options = parser.parse_args()
    if options.guided:
        guided(options.reader[0] if options.reader else "ply")
        return 0
    faults = run(options.reader, options.seed, None, options.seconds)
    print("\n".join(faults))
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
