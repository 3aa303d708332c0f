"""The notebook that compares the methods runs from top to bottom."""

from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parents[1] / "notebooks" / "methods.ipynb"


@pytest.mark.slow
def test_the_notebook_runs():
    nbformat = pytest.importorskip("nbformat", reason="needs the notebook extra")
    nbclient = pytest.importorskip("nbclient", reason="needs the notebook extra")
    pytest.importorskip("ipykernel", reason="needs the notebook extra")
    pytest.importorskip("matplotlib", reason="needs the notebook extra")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    place = {"metadata": {"path": str(NOTEBOOK.parent)}}
    nbclient.NotebookClient(notebook, timeout=900, resources=place).execute()
    said = "".join(
        output.text
        for cell in notebook.cells
        if cell.cell_type == "code"
        for output in cell.outputs
        if output.output_type == "stream" and output.name == "stdout"
    )
    volumes = dict(line.rsplit(" volume ", 1) for line in said.splitlines() if " volume " in line)
    volumes = {name.strip(): value for name, value in volumes.items()}
    assert abs(float(volumes["dual quaternions"]) - 1) < 0.02
    assert float(volumes["linear, biharmonic"]) < 0.7
