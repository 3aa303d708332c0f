"""The files of the command ``deform``: a mesh or a numbered series of them, and a picture."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

import jaxdeform as jd
from jaxdeform._apps.moves import Moves
from jaxdeform._apps.results import save_result
from jaxdeform._apps.talk import console, say_wrote
from jaxdeform._errors import printable
from jaxdeform._mesh.files import check_output, format_of, without_suffix
from jaxdeform._plotting.files import check_picture_path


class Output(NamedTuple):
    """Where the result goes."""

    out: Path
    frames: int | None
    """Number of frames: then ``out.obj`` stands for ``out_0001.obj`` and so on."""
    picture: Path | None

    def name(self, frame: int) -> Path:
        """Return the name of a frame; they are numbered from 1."""
        if self.frames is None:
            return self.out
        stem = without_suffix(self.out).name
        return self.out.with_name(f"{stem}_{frame:04d}{self.out.name[len(stem) :]}")

    @property
    def names(self) -> list[Path]:
        """The mesh files, in order."""
        return [self.name(k + 1) for k in range(self.frames or 1)]

    def check(self, shape: jd.Mesh) -> None:
        """Raise InputError if a file cannot be written."""
        format_of(self.out)
        for name in self.names:
            check_output(name, shape)
        if self.picture is None:
            return
        if self._animated and self.frames is None:
            raise jd.InputError(
                f"{self.picture}: a GIF shows the frames of a path: give --frames N, or use a .png "
                "name"
            )
        check_picture_path(self.picture, ".gif" if self._animated else ".png")

    @property
    def _animated(self) -> bool:
        return self.picture is not None and self.picture.suffix.lower() == ".gif"

    def save(
        self,
        shape: jd.Mesh,
        poses: Float[np.ndarray, "frames vertices 3"],
        rigidity: Float[np.ndarray, "vertices"] | None,
    ) -> None:
        """Write the meshes. What one cannot hold keeps no other from being written."""
        color = rigidity if format_of(self.out) == ".ply" else None
        failed = None
        for name, pose in zip(self.names, poses, strict=True):
            try:
                save_result(name, shape, pose, color)
            except jd.InputError as error:
                failed = failed or error
        if failed:
            raise failed

    def say_wrote(self) -> None:
        """Say which files were written, and which look as if they had been."""
        if self.frames is None:
            say_wrote(self.out)
            return
        first, last = (printable(str(name)) for name in (self.name(1), self.name(self.frames)))
        console.print(f"wrote {first} to {last}")
        behind = self.name(self.frames + 1)
        if behind.exists():
            console.print(
                f"{printable(str(behind))} was there before: it is no frame of this path, and nor "
                "are those after it"
            )

    def draw(
        self,
        shape: jd.Mesh,
        moves: Moves,
        poses: Float[np.ndarray, "frames vertices 3"],
        rigidity: Float[np.ndarray, "vertices"] | None,
    ) -> None:
        """Write the picture, if one is asked for, with the rigidity as colour and the handles."""
        if self.picture is None:
            return
        handles, moved = moves.handles, moves.handles[moves.moved]
        if self._animated:
            jd.animate(self.picture, shape, poses, values=rigidity, handles=handles, moved=moved)
        else:
            jd.render(
                self.picture,
                shape,
                [shape.vertices, poses[-1]],
                titles=["rest", "deformed"],
                values=[] if rigidity is None else [None, rigidity],
                handles=handles,
                moved=moved,
            )
        say_wrote(self.picture)
