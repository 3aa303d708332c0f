"""Compare the speed of two source trees: ``python -m benchmarks.compare OLD NEW [--rounds 7]``.

Each tree runs in a long-lived process of its own, which the two take in turns, so that a machine
that changes its pace changes it for both. Which goes first alternates. The report gives the median
seconds of each and the median over the rounds of new / old, with the quartiles beside it: where
they lie on both sides of 1, no difference is seen. First calls are measured in new processes,
without a compilation cache.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any, NamedTuple, cast

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

from benchmarks import workloads  # noqa: E402 (after x64)
from benchmarks.workloads import Workload  # noqa: E402

CHILD = Path(__file__).parent / "children" / "compare.py"

LOADS: dict[str, Callable[[], Workload]] = {
    "bar": workloads.bar,
    "cylinder": workloads.cylinder,
    "cactus": workloads.cactus,
    "octopus": lambda: workloads.octopus(50_000),
}


class Job(NamedTuple):
    """Something that both trees do, and how many units of the report one run of it is."""

    name: str
    load: str
    kind: str
    settings: dict[str, Any]
    units: int = 1


JOBS = [
    *(
        Job(f"iteration, {load}, {dtype}", load, "iteration", {"dtype": dtype, "steps": 20}, 20)
        for load in ("cylinder", "octopus")
        for dtype in ("float64", "float32")
    ),
    *(
        Job(f"to 1e-4, {load}, rigidity {x:g}", load, "descent", {"rigidity": x})
        for load in ("bar", "cylinder", "cactus")
        for x in (1.0, 0.05)
    ),
    Job("batch of 64, bar", "bar", "batch", {"size": 64}),
    *(Job(f"gradient, {load}", load, "gradient", {}) for load in ("bar", "cylinder")),
    *(
        Job(f"precompute{and_step}, {load}", load, "precompute", {"steps": steps})
        for load in ("bar", "cylinder")
        for steps, and_step in ((0, ""), (1, " and 1 step"))
    ),
]

FIRST = {f"first call, {load}": load for load in ("bar", "cylinder")}


class Row(NamedTuple):
    """The seconds of old and new in each round."""

    name: str
    old: list[float]
    new: list[float]
    note: str = ""

    def as_markdown(self) -> str:
        low, ratio, high = np.quantile(np.divide(self.new, self.old), [0.25, 0.5, 0.75])
        old, new = (f"{1e3 * np.median(x):.4g} ms" for x in (self.old, self.new))
        spread = f"{low:.3f} to {high:.3f}"
        return f"| {self.name} | {old} | {new} | {ratio:.3f} | {spread} | {self.note} |"


class Child:
    """A process that holds one tree and answers commands."""

    def __init__(self, tree: Path, *arguments: str, **environment: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-P", str(CHILD), *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, **environment, "PYTHONPATH": str(tree)},
        )
        loaded = self.answer()["tree"]
        if Path(loaded).resolve() != tree.resolve():
            self.close()
            raise RuntimeError(f"jaxdeform came from {loaded} instead of {tree}")

    def answer(self) -> dict[str, Any]:
        line = cast(IO[str], self._process.stdout).readline()
        if not line:
            raise RuntimeError(f"the child process ended, code {self._process.wait()}: see above")
        return json.loads(line)

    def ask(self, do: str, name: str, **settings: object) -> dict[str, Any]:
        pipe = cast(IO[str], self._process.stdin)
        pipe.write(json.dumps({"do": do, "name": name, **settings}) + "\n")
        pipe.flush()
        return self.answer()

    def close(self) -> None:
        """End the process: it stops where its commands end."""
        cast(IO[str], self._process.stdin).close()
        self._process.wait()
        cast(IO[str], self._process.stdout).close()


def in_turns(
    rounds: int, old: Callable[[], Any], new: Callable[[], Any]
) -> tuple[list[Any], list[Any]]:
    """Return what each answers in each round. Old goes first in even rounds, new in odd ones."""
    olds, news = [], []
    for k in range(rounds):
        pair = [(old, olds), (new, news)]
        for side, answers in pair if k % 2 == 0 else reversed(pair):
            answers.append(side())
    return olds, news


def compare_job(job: Job, file: Path, old: Child, new: Child, rounds: int) -> Row:
    for side in (old, new):
        side.ask("prepare", job.name, kind=job.kind, file=str(file), **job.settings)
    olds, news = in_turns(
        rounds, lambda: old.ask("run", job.name), lambda: new.ask("run", job.name)
    )
    for side in (old, new):
        side.ask("drop", job.name)
    before, after = olds[-1]["note"], news[-1]["note"]
    seconds = ([x["seconds"] / job.units for x in side] for side in (olds, news))
    return Row(job.name, *seconds, note=before if before == after else f"{before} -> {after}")


def compare_first_calls(
    name: str, file: Path, trees: tuple[Path, Path], rounds: int
) -> Iterator[Row]:
    """Yield a row for the first deformation in a new process, and one with the imports."""

    def first(tree: Path) -> dict[str, float]:
        child = Child(tree, "first", str(file), JAX_ENABLE_COMPILATION_CACHE="false")
        try:
            return child.answer()
        finally:
            child.close()

    olds, news = in_turns(rounds, lambda: first(trees[0]), lambda: first(trees[1]))
    yield Row(name, [x["deform"] for x in olds], [x["deform"] for x in news])
    whole = f"{name}, with imports and precomputation"
    yield Row(whole, [sum(x.values()) for x in olds], [sum(x.values()) for x in news])


def compare(trees: tuple[Path, Path], rounds: int, only: str) -> Iterator[Row]:
    """Yield the rows of all jobs whose names contain ``only``."""
    jobs = [job for job in JOBS if only in job.name]
    first = {name: load for name, load in FIRST.items() if only in name}
    with tempfile.TemporaryDirectory() as folder:
        files = {}
        for load in sorted({job.load for job in jobs} | set(first.values())):
            files[load] = Path(folder) / f"{load}.npz"
            write(LOADS[load](), files[load])
        old, new = (Child(tree) for tree in trees)
        try:
            for job in jobs:
                yield compare_job(job, files[job.load], old, new, rounds)
        finally:
            old.close()
            new.close()
        for name, load in first.items():
            yield from compare_first_calls(name, files[load], trees, min(rounds, 5))


def write(load: Workload, file: Path) -> None:
    np.savez(
        file,
        vertices=load.mesh.vertices,
        faces=load.mesh.faces,
        handles=load.handles,
        targets=load.targets,
        start=load.start,
    )


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.compare", description=__doc__)
    parser.add_argument("old", type=Path, help="source tree (the folder that holds jaxdeform/)")
    parser.add_argument("new", type=Path, help="source tree to compare with it")
    parser.add_argument("--rounds", type=int, default=7, help="first calls: 5 at most")
    parser.add_argument("--only", default="", metavar="TEXT", help="rows whose name contains this")
    options = parser.parse_args()
    for tree in (options.old, options.new):
        if not (tree / "jaxdeform" / "__init__.py").exists():
            parser.error(f"{tree} holds no jaxdeform/")
    print("| what | old | new | new / old | quartiles | |\n|---|---:|---:|---:|---:|---|")
    trees = options.old.resolve(), options.new.resolve()
    for row in compare(trees, options.rounds, options.only):
        print(row.as_markdown(), flush=True)


if __name__ == "__main__":
    main()
