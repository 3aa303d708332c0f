"""Skeletons: joints and bones, read from .tgf files."""

import os
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jaxdeform._arrays import read_only
from jaxdeform._checks import read_path
from jaxdeform._errors import InputError, shown
from jaxdeform._mesh.reading import read_text
from jaxdeform._mesh.words import real, whole


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Joints and the bones between them; made by `load_skeleton`.

    **Fields**

    - joints: (joints, 3) positions, in the unit of the file.
    - bones: (bones, 2) the two joints of each bone.
    """

    joints: Float[np.ndarray, "joints 3"]
    bones: Int[np.ndarray, "bones 2"]

    def __post_init__(self) -> None:
        """Freeze the arrays."""
        for name in ("joints", "bones"):
            object.__setattr__(self, name, read_only(np.array(getattr(self, name))))

    def __reduce__(self):
        """Pickle the content; loading freezes it again."""
        return Skeleton, (self.joints, self.bones)

    @property
    def segments(self) -> Float[np.ndarray, "bones 2 3"]:
        """Both ends of each bone: the controls of the skinning weights."""
        return self.joints[self.bones]

    def __repr__(self) -> str:
        """Return the sizes, not the arrays."""
        return f"Skeleton({len(self.joints)} joints, {len(self.bones)} bones)"


def load_skeleton(path: str | os.PathLike[str]) -> Skeleton:
    """Read a skeleton from a ``.tgf`` file, a graph as the skinning programs of Jacobson use it.

    The file lists the joints as lines ``number x y z``, numbered from 1; then a line ``#``; then
    the edges as lines ``i j``, which may end in three flags (bone, pseudo, cage). An edge without
    flags is a bone.

    **Arguments**: path of a ``.tgf`` file.

    **Returns** a `Skeleton` with all joints, and with the edges that are bones.

    **Raises** InputError naming the file and the line; also for a bone of length zero and a file
    without bones.

    Example:
        >>> import jaxdeform as jd, pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "arm.tgf"
        >>> _ = path.write_text("1 0 0 0\\n2 0 1 0\\n3 0 2 0\\n#\\n1 2\\n2 3\\n")
        >>> jd.load_skeleton(path)
        Skeleton(3 joints, 2 bones)
    """
    path = read_path("path", path)
    if path.suffix.lower() != ".tgf":
        raise InputError(f"{path}: skeletons are .tgf files, not '{path.suffix}'")
    lines = read_text(path).splitlines()
    joints: list[list[float]] = []
    bones: list[list[int]] = []
    section = 0
    for number, words in enumerate((line.split() for line in lines), start=1):
        where = f"{path}, line {number}"
        if words[:1] == ["#"]:
            section += 1
        elif words and section == 0:
            joints.append(_joint(where, words, len(joints) + 1))
        elif words and section == 1:
            i, j, *flags = _edge(where, words, len(joints))
            if not flags or flags[0]:
                if joints[i] == joints[j]:
                    raise InputError(f"{where}: the bone from {i + 1} to {j + 1} has length zero")
                bones.append([i, j])
    if not bones:
        raise InputError(f"{path}: has {len(joints)} joints and no bones: is the line '#' missing?")
    return Skeleton(np.array(joints), np.array(bones))


def _joint(where: str, words: list[str], expected: int) -> list[float]:
    try:
        number, *_ = (whole(word.encode()) for word in words[:1])
        position = [real(word.encode()) for word in words[1:]]
    except ValueError:
        raise InputError(
            f"{where}: {shown(' '.join(words))} is not a joint: give 'number x y z'"
        ) from None
    if number != expected or len(position) != 3 or not np.isfinite(position).all():
        raise InputError(f"{where}: expected joint {expected} as '{expected} x y z'")
    return position


def _edge(where: str, words: list[str], count: int) -> list[int]:
    try:
        i, j, *flags = (whole(word.encode()) for word in words)
    except ValueError:
        raise InputError(f"{where}: {shown(' '.join(words))} is not an edge: give 'i j'") from None
    if not (1 <= i <= count and 1 <= j <= count):
        raise InputError(
            f"{where}: edge {i} {j} names a joint out of range: joints are 1 to {count}"
        )
    return [i - 1, j - 1, *flags]
