"""The results of a batch run: one Zarr store, in which every block of jobs is a chunk of its own.

docs/batches.md has the layout. A block's ``result`` is written last: it is what says that the block
is done.
"""

import hashlib
import json
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import zarr
from zarr.errors import GroupNotFoundError

import jaxdeform as jd
from jaxdeform._apps.batch.job import Job, digest_of
from jaxdeform._apps.batch.work import Done
from jaxdeform._result import MEMBERS

# A zarr.Group. Its types do not tell a group from an array.
Root = Any

FOLDER = "results.zarr"
LAYOUT = 1
# Codes of the array `result`: the members of `Result`, and one of the run's own.
CODES = (*MEMBERS, "failed")
FAILED, WAITING = len(MEMBERS), -1
# Jobs that are written together: as many as are lost where a worker is killed.
JOBS_IN_BLOCK = 8
_BLOCK_BYTES = 2**25
SCALARS = {
    "result": ("int16", WAITING),
    "energy": ("float64", np.nan),
    "misfit": ("float64", np.nan),
    "steps": ("int32", 0),
    "flipped": ("int32", 0),
    "seconds": ("float64", np.nan),
}


class Block(NamedTuple):
    """Some jobs of one mesh, done by one worker one after the other."""

    mesh: int
    """The number of its group."""
    number: int
    first: int
    """The place of its first job in the arrays of the group."""
    rows: list[int]
    """The rows of the manifest, from 0."""
    jobs: list[Job]

    @property
    def key(self) -> str:
        return f"{self.mesh}-{self.number}"


def opened(run: str) -> Root:
    """Return the store of a run, a folder or an fsspec address."""
    return zarr.open_group(_place(run), mode="r+")


def _place(run: str) -> str:
    return f"{run.rstrip('/')}/{FOLDER}"


def make(run: str, jobs: list[Job]) -> Root:
    """Make the store of a new run. What an interrupted making has left is made again."""
    mark = {"made_by": "jaxdeform", "complete": False}  # one write: there is no store without it
    root: Root = zarr.create_group(_place(run), overwrite=True, attributes=mark)
    root.create_array("manifest", data=_bytes("\n".join(job.as_json() for job in jobs)))
    root.create_group("started")
    by_mesh: dict[str, list[int]] = {}
    for row, job in enumerate(jobs):
        by_mesh.setdefault(job.mesh, []).append(row)
    for number, (mesh, rows) in enumerate(by_mesh.items()):
        _make_group(root, number, mesh, sorted(rows, key=lambda row: str(jobs[row].problem)))
    identity = identity_of(jobs)
    root.attrs.update({**identity, "codes": list(CODES), "meshes": len(by_mesh), "complete": True})
    return root


def _make_group(root: Root, number: int, name: str, rows: list[int]) -> None:
    try:
        shape = jd.load_mesh(name)
        n, faces = shape.n_vertices, shape.faces
    except jd.InputError:  # its jobs will say why
        n, faces = 0, np.zeros((0, 3), int)
    group = root.create_group(f"mesh_{number}", attributes={"mesh": name})
    each = max(1, min(JOBS_IN_BLOCK, _BLOCK_BYTES // max(1, 32 * n)))
    group.create_array("row", data=np.asarray(rows), dimension_names=("job",))
    corners = np.asarray(faces, np.int64)
    group.create_array("faces", data=corners, dimension_names=("face", "corner"))
    count, names = len(rows), ("job", "vertex", "axis")
    for field, shape in {"vertices": (n, 3), "rigidity": (n,)}.items():
        group.create_array(
            field,
            shape=(count, *shape),
            chunks=(each, *(max(1, size) for size in shape)),
            dtype="float64",
            fill_value=np.nan,
            dimension_names=names[: 1 + len(shape)],
        )
    for field, (dtype, fill) in SCALARS.items():
        group.create_array(
            field,
            shape=(count,),
            chunks=(each,),
            dtype=dtype,
            fill_value=fill,
            dimension_names=("job",),
        )


def identity_of(jobs: list[Job]) -> dict[str, Any]:
    """Return what must be the same where a run goes on: jobs, files, version."""
    text = "\n".join(job.as_json() for job in jobs)
    files = sorted({name for job in jobs for name in job.files})
    return {
        "layout": LAYOUT,
        "version": jd.__version__,
        "jobs": hashlib.sha256(text.encode()).hexdigest(),
        "files": {name: digest_of(name) for name in files},
    }


def check_same(run: str, root: Root, jobs: list[Job]) -> None:
    """Raise InputError unless the run was begun with these jobs, files and this version."""
    old, new = dict(root.attrs), identity_of(jobs)
    for what, said in {
        "layout": "its layout is of another version of jaxdeform",
        "version": f"it was begun by jaxdeform {old.get('version')}; this is {jd.__version__}",
        "jobs": "it was begun with another manifest",
    }.items():
        if old.get(what) != new[what]:
            raise jd.InputError(f"{run}: {said}: give another folder to -o")
    _check_digests(run, old["files"], new["files"])


def check_files(run: str, root: Root, names: set[str]) -> None:
    """Raise InputError unless these files are as they were when the run was begun."""
    _check_digests(run, root.attrs["files"], {name: digest_of(name) for name in sorted(names)})


def _check_digests(run: str, old: dict[str, str], new: dict[str, str]) -> None:
    for name, digest in new.items():
        if old.get(name) != digest:
            raise jd.InputError(
                f"{run}: the file {name} has changed since it was begun: restore it, or begin a "
                "run in another folder"
            )


def is_run(root: Root) -> bool:
    return root.attrs.get("made_by") == "jaxdeform"


def find(run: str) -> Root | None:
    """Return the store of a run that was begun, or None where there is none."""
    try:
        return opened(run)
    except (FileNotFoundError, GroupNotFoundError):
        return None


def jobs_of(root: Root) -> list[Job]:
    return [Job.of_json(line) for line in _text(root["manifest"]).splitlines()]


def groups(root: Root) -> list[Root]:
    """Return the group of each mesh, in order."""
    return [root[f"mesh_{number}"] for number in range(int(root.attrs["meshes"]))]


def blocks(root: Root, jobs: list[Job]) -> Iterator[tuple[Block, bool]]:
    """Return all blocks, and whether each is done."""
    for mesh, group in enumerate(groups(root)):
        rows, result = group["row"][:], group["result"]
        each, codes = result.chunks[0], result[:]
        for number, first in enumerate(range(0, len(rows), each)):
            own = [int(row) for row in rows[first : first + each]]
            done = not (codes[first : first + each] == WAITING).any()
            yield Block(mesh, number, first, own, [jobs[row] for row in own]), done


def write(root: Root, block: Block, done: Sequence[Done | str]) -> None:
    """Write what came of the jobs of a block, or why nothing did: all, then that it is done."""
    group = root[f"mesh_{block.mesh}"]
    place = slice(block.first, block.first + len(done))
    errors = {row: x for row, x in zip(block.rows, done, strict=True) if isinstance(x, str)}
    if errors:
        name = f"errors_{block.number}"
        text = _bytes(json.dumps(errors))
        group.create_array(name, data=text, dimension_names=(f"byte_{name}",), overwrite=True)
    n = group["vertices"].shape[1]
    blank = Done(
        np.full((n, 3), np.nan), np.full(n, np.nan), np.nan, np.nan, 0, 0, "failed", np.nan
    )
    full = [blank if isinstance(x, str) else x for x in done]
    for field in ("vertices", "rigidity", *reversed(SCALARS)):  # result last
        values = [getattr(x, field) for x in full]
        if field == "result":
            values = [CODES.index(x) for x in values]
        group[field][place] = np.asarray(values, group[field].dtype)


def errors_of(root: Root) -> dict[int, str]:
    """Return why jobs failed, by row."""
    found = {}
    for group in groups(root):
        codes, each = group["result"][:], group["result"].chunks[0]
        for number in sorted({k // each for k in np.flatnonzero(codes == FAILED)}):
            texts = json.loads(_text(group[f"errors_{number}"]))
            found |= {int(row): text for row, text in texts.items()}
    return found


# ---------------------------------------------------------------- what was begun


def began(root: Root, block: Block) -> dict[str, Any] | None:
    """Return what is noted of a block that was begun and not finished; None if it was not."""
    name = f"started/{block.key}"
    return dict(root[name].attrs) if name in root else None


def note(root: Root, block: Block, what: dict[str, Any]) -> None:
    """Note something of a block that was begun: in its attributes, which are one write."""
    root.create_group(f"started/{block.key}", attributes=what, overwrite=True)


def forget(root: Root, block: Block) -> None:
    if f"started/{block.key}" in root:
        del root[f"started/{block.key}"]


def _bytes(text: str) -> np.ndarray:
    return np.frombuffer(text.encode(), np.uint8)


def _text(array: Any) -> str:
    return array[:].tobytes().decode()
