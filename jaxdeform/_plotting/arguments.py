"""Read the arguments of pictures, or raise an InputError that names the one at fault."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxdeform._arrays import read_host_array
from jaxdeform._checks import check_flag, check_type
from jaxdeform._errors import InputError, a_or_an, shown
from jaxdeform._mesh.extras import file_colors
from jaxdeform._mesh.mesh import Mesh
from jaxdeform._mesh.selection import check_handles, read_mask
from jaxdeform._plotting.camera import guess_up
from jaxdeform._plotting.color import NEUTRAL, Scale, rgb, scale_of
from jaxdeform._plotting.scene import Dots
from jaxdeform._plotting.surface import Coat, Surface
from jaxdeform._values import read_axis

STRETCH = "stretch"

Pose = Float[np.ndarray, "vertices 3"]

# A pose that reaches this many times as far as the others is cut off.
_FAR = 5.0


class Look(NamedTuple):
    """How a mesh is drawn, the same in all panels."""

    mesh: Mesh
    handles: Int[np.ndarray, "handles"] | None
    moved: Bool[np.ndarray, "handles"] | None
    """None: those that a pose moves."""
    up: Float[np.ndarray, "3"]
    edges: bool

    def dots(self, poses: Sequence[Pose]) -> Dots | None:
        """Return the handles, and which of them move in any of these poses."""
        if self.handles is None:
            return None
        move = self.moved
        if move is None:
            rest = self.mesh.vertices[self.handles]
            far = [np.linalg.norm(pose[self.handles] - rest, axis=1) for pose in poses]
            move = (np.array(far).reshape(-1, len(rest)) > 1e-6 * self.mesh.diagonal).any(axis=0)
        return Dots(self.handles, np.asarray(move))


def read_look(mesh: Any, handles: Any, moved: Any, up: Any, edges: Any) -> Look:
    """Check what all pictures share, or raise InputError."""
    check_type("mesh", mesh, Mesh)
    check_flag("edges", edges)
    direction = guess_up(mesh) if up is None else read_axis("up", up)
    chosen = None if handles is None else check_handles(handles, mesh)
    move = None
    if moved is not None:
        if chosen is None:
            raise InputError("moved says which handles move, but handles is None: give both")
        mask = read_mask("moved", moved, mesh, "moved vertex")
        move = mask[chosen]
        mask[chosen] = False
        if mask.any():
            raise InputError(
                f"moved: vertex {np.flatnonzero(mask)[0]} is no handle: name it in handles too"
            )
    return Look(mesh, chosen, move, direction, edges)


# ---------------------------------------------------------------- poses


def read_poses(mesh: Mesh, poses: Any, name: str = "poses") -> list[Pose]:
    """Return one array (vertices, 3) per pose. Numbers that are not finite are allowed."""
    poses = listed(name, poses, "positions (vertices, 3)")
    if not poses:
        raise InputError(f"{name} is empty: give at least one, such as [mesh.vertices]")
    out = []
    for k, pose in enumerate(poses):
        array = read_host_array(pose, np.float64, f"{name}[{k}]")
        if array.shape != mesh.vertices.shape:
            raise InputError(
                f"{name}[{k}] has shape {array.shape}, expected {mesh.vertices.shape}: one row per "
                "vertex"
            )
        out.append(array)
    return out


class Fault(NamedTuple):
    """What is wrong with a pose, in words for its title, or nothing."""

    words: str
    frames: bool
    """Whether the picture is made large enough for the pose."""


def find_faults(mesh: Mesh, poses: Sequence[Pose]) -> list[Fault]:
    """Tell which poses are not finite, or so large that the others would vanish beside them."""
    finite = [pose[np.isfinite(pose).all(axis=1)] for pose in poses]
    boxes = [_box(points) for points in finite if len(points)]
    boxes.append(_box(mesh.vertices[mesh.referenced]))
    # The lower median: half of the poses may explode.
    middle = np.sort([center for center, _ in boxes], axis=0)[(len(boxes) - 1) // 2]
    usual = np.sort([size for _, size in boxes])[(len(boxes) - 1) // 2]
    with np.errstate(over="ignore"):
        reach = [
            float(np.linalg.norm(points / 4 - middle / 4, axis=1).max(initial=0.0)) / (usual / 8)
            for points in finite
        ]
    near = [len(points) > 0 and far < _FAR for points, far in zip(finite, reach, strict=True)]
    out = []
    for points, far, fits in zip(finite, reach, near, strict=True):
        words, lost = "", mesh.n_vertices - len(points)
        if lost:
            words = f"{lost} of {mesh.n_vertices} vertices not finite"
        # Where all are large, all are shown.
        if len(points) and not fits and any(near):
            words += f"{', ' if words else ''}reaches {far:.3g} times as far: cut off"
        out.append(Fault(words, bool(len(points)) and (fits or not any(near))))
    return out


def _box(points: np.ndarray) -> tuple[np.ndarray, float]:
    low, high = points.min(axis=0), points.max(axis=0)
    with np.errstate(over="ignore"):
        return low / 2 + high / 2, float(np.linalg.norm(high / 2 - low / 2)) * 2


# ---------------------------------------------------------------- values


class Paint(NamedTuple):
    """How each pose is painted, and what the colours mean."""

    coats: list[Coat]
    scale: Scale | None
    label: str


def read_paint(
    surface: Surface, poses: Sequence[Pose], faults: Sequence[Fault], values: Any, label: Any
) -> Paint:
    """Return the colours of all poses, by one scale. Poses that are cut off do not stretch it."""
    check_text("label", label)
    numbers = _read_values(surface, poses, values)
    shown_ = [v for v, fault in zip(numbers, faults, strict=True) if v is not None and fault.frames]
    scale = scale_of(shown_) or scale_of([v for v in numbers if v is not None])
    own = file_colors(surface.mesh.source)
    plain = np.tile(rgb(NEUTRAL), (surface.mesh.n_vertices, 1)) if own is None else own
    coats = [
        Coat(plain, textured=True)
        if v is None or scale is None
        else Coat(scale.colors(v), textured=False)
        for v in numbers
    ]
    return Paint(coats, scale, label or (STRETCH if isinstance(values, str) else "rigidity"))


def _read_values(surface: Surface, poses: Sequence[Pose], values: Any) -> list[np.ndarray | None]:
    """Return one array (vertices,) or None per pose."""
    if isinstance(values, str):
        if values != STRETCH:
            raise InputError(f"values is the text {shown(values)}: give 'stretch' or numbers")
        with np.errstate(invalid="ignore", over="ignore"):
            return [surface.stretch(pose) for pose in poses]
    values = listed("values", values, "arrays, numbers or None, one per pose")
    if len(values) > len(poses):
        raise InputError(
            f"values has {len(values)} entries for {len(poses)} poses: give one per pose"
        )
    out: list[np.ndarray | None] = [None] * len(poses)
    for k, value in enumerate(values):
        if value is not None:
            out[k] = read_value(f"values[{k}]", value, poses[k])
    return out


def read_value(name: str, value: Any, pose: Pose) -> Float[np.ndarray, "vertices"]:
    """Return one number per vertex; not finite only where the pose is not finite either."""
    n = len(pose)
    given = read_host_array(value, np.float64, name)
    sound = np.isfinite(pose).all()
    if given.shape not in ((), (n,)) or (sound and not np.isfinite(given).all()):
        raise InputError(
            f"{name} has shape {given.shape}: give None, a finite number or ({n},) of them"
        )
    return np.broadcast_to(given, n)


# ---------------------------------------------------------------- lists and texts


def listed(name: str, value: Any, of: str) -> list[Any]:
    """Return the entries of a list or an array; text is a list of letters, a dict of keys."""
    array = isinstance(value, np.ndarray | jax.Array) and value.ndim > 0
    if not array and not isinstance(value, list | tuple):
        raise InputError(f"{name} is {a_or_an(value)}: give a list of {of}")
    return list(value)


def read_texts(name: str, value: Any, most: int) -> list[str]:
    """Return up to so many texts."""
    texts = listed(name, value, "texts, one per pose")
    if len(texts) > most:
        raise InputError(f"{name} has {len(texts)} entries for {most} poses: give one per pose")
    for k, text in enumerate(texts):
        check_text(f"{name}[{k}]", text)
    return texts


def check_text(name: str, text: Any) -> None:
    """Raise InputError unless it is a text."""
    if not isinstance(text, str):
        raise InputError(f"{name} is {a_or_an(text)}: give a text")
