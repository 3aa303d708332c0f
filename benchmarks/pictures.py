"""Pictures of the benchmarks: energy against time, time against size."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt

from benchmarks.metrics import Curve


def draw(curves: dict[str, dict[str, Curve]], folder: Path) -> list[Path]:
    """Write a PNG of energy against time and one of time against size, where they were measured."""
    written = []
    loads = [name for name in curves if name != "size"]
    if loads:
        figure, axes = plt.subplots(1, len(loads), figsize=(5 * len(loads), 4), squeeze=False)
        for axis, name in zip(axes[0], loads, strict=True):
            for label, (seconds, energy) in curves[name].items():
                axis.loglog([1e3 * max(s, 1e-5) for s in seconds], energy, label=label)
            axis.axhline(1e-4, color="gray", linewidth=0.5)
            axis.set(title=name, xlabel="milliseconds", ylabel="energy / its minimum - 1")
            axis.legend(fontsize=7)
        written.append(_save(figure, folder / "energy-against-time.png"))
    if "size" in curves:
        figure, axis = plt.subplots(figsize=(5, 4))
        for label, (counts, seconds) in curves["size"].items():
            axis.loglog(counts, [1e3 * s for s in seconds], marker="o", label=label)
        axis.set(xlabel="vertices", ylabel="milliseconds per iteration")
        axis.legend(fontsize=8)
        written.append(_save(figure, folder / "time-against-size.png"))
    return written


def _save(figure, path: Path) -> Path:
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path
