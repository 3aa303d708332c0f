"""A job of a batch run, and the files that it reads."""

import hashlib
import json
import os
from pathlib import Path
from typing import Any, NamedTuple

import jaxdeform as jd
from jaxdeform._apps.methods import Method
from jaxdeform._handles.files import motion_beside


class Job(NamedTuple):
    """One row: a deformation, or a fit where it has poses. Paths are absolute, None is blank."""

    job: str
    mesh: str
    handles: str | None = None
    fix: str | None = None
    move: str | None = None
    rotate: tuple[str, float] | None = None
    about: tuple[float, ...] | None = None
    translate: tuple[float, ...] | None = None
    frames: int | None = None
    method: str = "material"
    rigidity: str | None = None
    stiff: tuple[str, ...] = ()
    rings: int = 1
    poses: tuple[str, ...] = ()
    alpha: float | None = None

    @property
    def problem(self) -> tuple[Any, ...]:
        """What jobs of one factor have in common."""
        spokes = Method(self.method).has_spokes
        return self.mesh, self.handles, self.fix, self.move, self.rings, spokes

    def as_json(self) -> str:
        """Return the row as text, and nothing that is blank."""
        values = {k: v for k, v in self._asdict().items() if v not in (None, ())}
        return json.dumps(values)

    @staticmethod
    def of_json(text: str) -> "Job":
        """Return what `as_json` wrote."""
        read = json.loads(text)
        values: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in read.items()
        }
        return Job(**values)

    @property
    def files(self) -> list[str]:
        """The files that it reads."""
        named = [*self.files_of_problem, *self.poses]
        if self.rigidity and os.path.isabs(self.rigidity):  # else a number
            named.append(self.rigidity)
        return named

    @property
    def files_of_problem(self) -> list[str]:
        """The files that jobs of one factor have in common."""
        named = [self.mesh, self.handles, self.handles and motion_beside(Path(self.handles))]
        return [str(name) for name in named if name]


def digest_of(name: str) -> str:
    """Return the digest of a file: another one where its content is another.

    **Raises** InputError where it cannot be read.
    """
    try:
        return hashlib.sha256(Path(name).read_bytes()).hexdigest()
    except OSError as error:
        raise jd.InputError(
            f"{name}: cannot be read ({error.strerror}): put it there again"
        ) from error
