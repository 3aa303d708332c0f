"""How the tests of the apps run the command line, and the files that they run it on."""

import json
import sys

import numpy as np
import pytest
from helpers import lower_and_upper

import jaxdeform as jd
from jaxdeform._apps.cli import main


@pytest.fixture
def run(monkeypatch, capsys):
    """Return a function that runs the command line: arguments -> (exit code, stdout, stderr)."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["jaxdeform", *map(str, arguments)])
        code = 0
        try:
            main()
        except SystemExit as end:
            code = end.code
        return code, *capsys.readouterr()

    return run


@pytest.fixture
def files(tmp_path, bar):
    """A bar, handles that bend it by 90 degrees (JSON and survey), a rigidity per vertex."""
    jd.save_mesh(tmp_path / "bar.off", bar)
    low, high = lower_and_upper(bar)
    turn = {"axis": [0, 0, 1], "degrees": -90, "center": [0, 75.5, 0]}
    groups = [{"vertices": low.tolist()}, {"vertices": high.tolist(), "rotation": turn}]
    (tmp_path / "bend.json").write_text(json.dumps({"handles": groups}))
    status = np.ones(722, int)
    status[low], status[high] = 0, 2
    (tmp_path / "bend.sel").write_text("\n".join(map(str, status)))
    (tmp_path / "bend.def").write_text("0 1 0 -75.5\n-1 0 0 75.5\n0 0 1 0\n0 0 0 1\n")
    values = np.where(bar.vertices[:, 1] < 75.5, 0.01, 30.0)
    jd.save_mesh(tmp_path / "rigidity.ply", bar, rigidity=values)
    jd.save_mesh(tmp_path / "short.ply", jd.shapes.square(), rigidity=1.0)
    jd.save_mesh(tmp_path / "plain.ply", bar)
    return tmp_path
