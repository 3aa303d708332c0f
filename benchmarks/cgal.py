"""CGAL's ARAP in a process of its own, where a compiler and CGAL's headers are (libcgal-dev)."""

import atexit
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path

import numpy as np

import jaxdeform as jd

_SOURCE = Path(__file__).with_name("cgal_arap.cpp")
_FLAGS = ["-std=c++17", "-DCGAL_EIGEN3_ENABLED", "-I/usr/include/eigen3"]


@cache
def program() -> Path | None:
    """Compile the program, or return None where the compiler or the headers are missing."""
    compiler = shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        return None
    asked = "#include <CGAL/Surface_mesh_deformation.h>\n#include <Eigen/Core>\n"
    command = [compiler, *_FLAGS, "-E", "-x", "c++", "-", "-o", "/dev/null"]
    if subprocess.run(command, input=asked, capture_output=True, text=True).returncode:
        return None
    folder = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    out = folder / "cgal_arap"
    command = [compiler, *_FLAGS, "-O3", "-DNDEBUG", _SOURCE, "-o", out, "-lgmp", "-lmpfr"]
    subprocess.run(command, check=True)
    return out


class Cgal:
    """ARAP of CGAL on one mesh; with alpha, that of smooth rotations.

    It takes no start: at first all rotations are the identity. Each `deform` goes on from the
    last one.
    """

    def __init__(self, mesh: jd.Mesh, handles, targets, alpha: float | None = None) -> None:
        found = program()
        if found is None:
            raise RuntimeError("CGAL cannot be compiled here: install libcgal-dev and g++")
        with tempfile.TemporaryDirectory() as name:
            mesh_file, handle_file = Path(name, "mesh.off"), Path(name, "handles")
            jd.save_mesh(mesh_file, mesh)
            rows = zip(np.asarray(handles), np.asarray(targets).tolist(), strict=True)
            lines = [f"{i} {x!r} {y!r} {z!r}\n" for i, (x, y, z) in rows]
            handle_file.write_text("".join(lines))
            extra = [] if alpha is None else [repr(alpha)]
            self._process = subprocess.Popen(
                [found, mesh_file, handle_file, *extra],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            self.seconds_to_prepare = float(self._line())

    def __enter__(self) -> "Cgal":
        return self

    def __exit__(self, *_: object) -> None:
        """End the process."""
        self._process.communicate("")

    def deform(self, iterations: int) -> None:
        self._ask(f"deform {iterations}")

    def reset(self) -> None:
        """Go back to the rest shape, with all rotations the identity."""
        self._ask("reset")

    def vertices(self) -> np.ndarray:
        return np.array([line.split() for line in self._ask("print")], float)

    def _ask(self, command: str) -> list[str]:
        assert self._process.stdin is not None
        print(command, file=self._process.stdin, flush=True)
        lines = []
        while (line := self._line()) != "done":
            lines.append(line)
        return lines

    def _line(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"CGAL ended with exit status {self._process.wait()}")
        return line.strip()
