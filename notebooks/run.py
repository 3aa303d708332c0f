"""Run the notebooks and write them back: ``python notebooks/run.py [NAME ...]``.

NAME is the beginning of a file's name, such as ``02``; without one all run. Of their outputs only
text and PNG pictures are kept, because a notebook that nobody has declared trusted shows nothing
else. What changes from run to run (times, counters, versions) is left out. Needs the extra
``notebook``.
"""

import os
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path

import nbformat
from nbclient import NotebookClient

HERE = Path(__file__).parent
_KEPT = ("image/png", "text/plain")


def execute(notebook: nbformat.NotebookNode, *, quick: bool = False) -> None:
    """Run a notebook from top to bottom, in a folder of its own; quick: at its reduced size."""
    environment = {**os.environ, "JAXDEFORM_NOTEBOOK_QUICK": "1" if quick else ""}
    with tempfile.TemporaryDirectory() as folder:
        place = {"metadata": {"path": folder}}
        client = NotebookClient(notebook, timeout=1200, kernel_name="python3", resources=place)
        client.execute(env=environment)


def tidy(notebook: nbformat.NotebookNode) -> None:
    """Leave the source, the text and the pictures."""
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    notebook.metadata = {"kernelspec": kernel, "language_info": {"name": "python"}}
    for cell in notebook.cells:
        cell.metadata = {}
        if cell.cell_type == "code":
            cell.execution_count = None
            cell.outputs = _joined(kept for output in cell.outputs if (kept := _kept(output)))


def _joined(outputs: Iterable[nbformat.NotebookNode]) -> list[nbformat.NotebookNode]:
    """Join what was printed in pieces: where it breaks is chance."""
    joined = []
    for output in outputs:
        if joined and output.output_type == joined[-1].output_type == "stream":
            joined[-1].text += output.text
        else:
            joined.append(output)
    return joined


def _kept(output: nbformat.NotebookNode) -> nbformat.NotebookNode | None:
    if output.output_type == "stream":
        return output if output.name == "stdout" else None
    data = {kind: output.data[kind] for kind in _KEPT if kind in output.data}
    if "image/png" in data:
        data.pop("text/plain", None)  # the name of a class
    return nbformat.v4.new_output("display_data", data) if data else None


if __name__ == "__main__":
    chosen = tuple(sys.argv[1:]) or ("",)
    for path in sorted(HERE.glob("*.ipynb")):
        if path.name.startswith(chosen):
            notebook = nbformat.read(path, as_version=4)
            execute(notebook)
            tidy(notebook)
            nbformat.write(notebook, path)
            print(f"{path.name}: {path.stat().st_size / 1024:.0f} KB")
