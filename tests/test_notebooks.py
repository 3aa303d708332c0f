"""Every notebook runs from top to bottom at its reduced size, and what it shows is so."""

import base64
import importlib.util
import json
import re
from pathlib import Path

import igl
import numpy as np
import pytest
from helpers import PEER
from scipy.spatial.transform import Rotation

import jaxdeform as jd

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
MOST_BYTES = 600_000


def source(cell: dict) -> str:
    return "".join(cell["source"])


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_small_and_shows_pictures_without_trust(path):
    assert path.stat().st_size < MOST_BYTES
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    assert re.match(r"# \S", source(cells[0]))
    pictures = 0
    for cell in cells:
        for output in cell.get("outputs", []):
            if output["output_type"] == "stream":
                assert output["name"] == "stdout"
                continue
            assert output["output_type"] == "display_data"
            (kind,) = output["data"]
            assert kind in ("image/png", "text/plain")
            if kind == "image/png":
                pictures += base64.b64decode(output["data"][kind]).startswith(b"\x89PNG")
    assert pictures


def test_every_notebook_is_on_the_site_and_has_a_test():
    site = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    here = Path(__file__).read_text(encoding="utf-8")
    for path in NOTEBOOKS:
        assert f"notebooks/{path.stem}.md" in site, path.name
        assert f'"{path.stem}"' in here, path.name


@pytest.fixture
def run(tmp_path):
    """Run a notebook at its reduced size; return what named expressions are worth at its end."""
    for package in ("nbformat", "nbclient", "ipykernel", "matplotlib", "pyvista", "k3d"):
        pytest.importorskip(package, reason="needs the notebook extra")
    import nbformat

    place = importlib.util.spec_from_file_location("run", ROOT / "notebooks" / "run.py")
    runner = importlib.util.module_from_spec(place)
    place.loader.exec_module(runner)

    def run(name: str, **wanted: str) -> dict[str, np.ndarray]:
        notebook = nbformat.read(ROOT / "notebooks" / f"{name}.ipynb", as_version=4)
        values = ", ".join(f"{key}=np.asarray({text})" for key, text in wanted.items())
        last = f"import numpy as np\nnp.savez({str(tmp_path / 'out.npz')!r}, {values})"
        notebook.cells.append(nbformat.v4.new_code_cell(last))
        runner.execute(notebook, quick=True)
        return dict(np.load(tmp_path / "out.npz"))

    return run


def motion(rest, pose):
    """Return the rotation vector that fits best, and the largest distance from a rigid motion."""
    a, b = rest - rest.mean(axis=0), pose - pose.mean(axis=0)
    turn, _ = Rotation.align_vectors(b, a)
    return turn.as_rotvec(degrees=True), np.linalg.norm(turn.apply(a) - b, axis=1).max()


def volume(vertices, faces):
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.einsum("ij,ij->", a, np.cross(b, c)) / 6


def staying(mesh, handles, targets, pose):
    """Return how far libigl's ARAP moves on from a pose, as a fraction of the diagonal."""
    data = igl.ARAPData()
    data.energy = igl.ARAP_ENERGY_TYPE_SPOKES
    data.max_iter = 20
    igl.arap_precomputation(mesh.vertices, mesh.faces, 3, handles, data)
    theirs = igl.arap_solve(np.asarray(targets), data, np.array(pose))
    return np.abs(theirs - pose).max() / mesh.diagonal


@pytest.mark.slow
def test_first_deformation(run):
    got = run(
        "01_first_deformation",
        top="top.vertices",
        foot="foot.vertices",
        rest="mesh.vertices",
        bent="bent.vertices",
        lifted="poses['pulled up']",
    )
    rest, top, foot = got["rest"], got["top"], got["foot"]
    turn, error = motion(rest[top], got["bent"][top])
    np.testing.assert_allclose(turn, [0, 0, -60], atol=1e-6)
    assert error < 1e-9
    np.testing.assert_allclose(got["bent"][foot], rest[foot], atol=1e-12)
    np.testing.assert_allclose(got["lifted"][top] - rest[top], [[0, 1.2, 0]] * len(top), atol=1e-9)
    # What is free follows, and nothing of it goes further.
    free = np.setdiff1d(np.arange(len(rest)), np.union1d(top, foot))
    rise = got["lifted"][free, 1] - rest[free, 1]
    assert -0.05 < rise.min() < 0.1
    assert 1.0 < rise.max() < 1.25


@pytest.mark.slow
def test_rigidity(run):
    got = run(
        "02_rigidity",
        rigidity="list(fits)",
        fits="[fits[k] for k in fits]",
        handles="problem.handles",
        targets="targets",
        arap="shown['ARAP']",
        gap="[jnp.abs(deform(r) - rotations).max() for r in (1e4, 1e5)]",
    )
    # Edges have weight 1/2 at the border, 1 inside, and 0 as diagonals. Two corners are no
    # neighbours of the centre, so B = 3 I in the plane. Then T has the singular directions of the
    # shear, and its singular values s minimise rigidity (s^2 - 1)^2 + 3 (s - sigma)^2.
    shear = np.array([[1, 0.8], [0, 1]])
    u, sigma, vt = np.linalg.svd(shear)
    for rigidity, t in zip(got["rigidity"], got["fits"], strict=True):
        roots = [np.roots([4 * rigidity, 0, 6 - 4 * rigidity, -6 * s]) for s in sigma]
        best = [max(r[np.abs(r.imag) < 1e-9].real) for r in roots]
        np.testing.assert_allclose(t[:2, :2], u @ np.diag(best) @ vt, atol=1e-6)
    # Rigidity to infinity: ten times nearer for ten times the rigidity.
    assert 9 < got["gap"][0] / got["gap"][1] < 11
    assert staying(jd.shapes.bar(), got["handles"], got["targets"], got["arap"]) < 1e-4


@pytest.mark.slow
def test_varying_rigidity(run):
    got = run(
        "03_varying_rigidity",
        stiff="rigidity['stiff above'] == STIFF",
        rest="mesh.vertices",
        bent="bent['stiff above']",
        twisted="twisted['stiff above']",
    )
    stiff, rest = got["stiff"], got["rest"]
    for pose in (got["bent"], got["twisted"]):
        # The stiff half moves nearly as one, and the soft half does not.
        assert motion(rest[stiff], pose[stiff])[1] < 0.4 * motion(rest[~stiff], pose[~stiff])[1]


@pytest.mark.slow
def test_rings_and_rigidity(run):
    got = run(
        "04_rings_and_rigidity",
        one="bent[0][-1]",
        two="bent[2][-1]",
        rest="mesh.vertices",
        faces="mesh.faces",
        handles="handles.vertices",
        targets="jd.bend(points, 90.0)",
    )
    mesh = jd.Mesh(got["rest"], got["faces"])
    star = [np.unique(mesh.faces[(mesh.faces == k).any(axis=1)]) for k in range(mesh.n_vertices)]
    i, j = mesh.edges.T
    apart = []
    for pose in (got["one"], got["two"]):
        np.testing.assert_allclose(pose[got["handles"]], got["targets"], atol=1e-9)
        turn = Rotation.from_rotvec(
            [motion(mesh.vertices[s], pose[s])[0] for s in star], degrees=True
        )
        apart.append(np.degrees((turn[i].inv() * turn[j]).magnitude()).max())
    # Larger cells agree more: neighbouring stars turn more alike.
    assert apart[1] < 0.7 * apart[0]


@pytest.mark.slow
def test_methods_side_by_side(run):
    got = run(
        "05_methods_side_by_side",
        rest="mesh.vertices",
        weight="w[:, 1]",
        handles="handles",
        linear="skinned['linear, biharmonic']",
        dual="skinned['dual quaternions']",
        arap="surface['ARAP']",
        targets="targets",
    )
    rest = got["rest"]
    radius = [np.hypot(pose[:, 0], pose[:, 2]) for pose in (rest, got["linear"], got["dual"])]
    shrunk = np.abs(got["weight"] * np.exp(1j * np.radians(135)) + 1 - got["weight"])
    np.testing.assert_allclose(radius[1], radius[0] * shrunk, atol=1e-9)
    np.testing.assert_allclose(radius[2], radius[0], atol=1e-9)
    assert staying(jd.shapes.bar(), got["handles"], got["targets"], got["arap"]) < 1e-4


@pytest.mark.slow
def test_one_tentacle(run):
    got = run(
        "06_one_tentacle",
        rest="mesh.vertices",
        whole="whole",
        index="piece.index",
        free="free.vertices",
        at_once="at_once.vertices",
        tip="tip.vertices",
    )
    rest, whole = got["rest"], got["whole"]
    diagonal = np.linalg.norm(np.ptp(rest, axis=0))
    assert np.abs(whole - got["at_once"]).max() < 1e-4 * diagonal  # what solvers leave
    held = np.setdiff1d(np.arange(len(rest)), np.union1d(got["free"], got["tip"]))
    np.testing.assert_allclose(whole[held], rest[held], atol=1e-12)
    turn, error = motion(rest[got["tip"]], whole[got["tip"]])
    assert error < 1e-9
    np.testing.assert_allclose(np.linalg.norm(turn), 60, atol=1e-6)
    assert len(got["index"]) < 0.2 * len(rest)


@pytest.mark.slow
def test_estimating_rigidity(run):
    got = run(
        "07_estimating_rigidity",
        found="found",
        handles="handles",
        interval="[f.interval[0] for f in (fit, together, *fits.values())]",
        thesis="[e.rigidity for e in ours_by_theirs.values()]",
        left="distances(1, 2, jnp.array([15.0, 30.0, 60.0]))",
    )
    assert set(got["found"]) == set(got["handles"])
    low, high = got["interval"].T
    assert (low < 30).all()
    assert (high > 30).all()
    assert (high / low < 1.1).all()
    # The thesis: "provides the least rigidity required".
    assert (got["thesis"] < 30).all()
    assert got["left"].argmin() == 1


@pytest.mark.slow
def test_fit_your_own_loss(run):
    got = run(
        "08_fit_your_own_loss",
        slope="gradient_at_start[3]",
        history="history",
        difference="difference",
    )
    np.testing.assert_allclose(got["slope"], got["difference"], rtol=0.05)
    assert got["history"][-1] < 0.3 * got["history"][0]


@pytest.mark.slow
def test_a_thousand_bends(run):
    got = run(
        "09_a_thousand_bends",
        poses="poses",
        left="left",
        ok="ok",
        faces="mesh.faces",
        rest="mesh.vertices",
        handles="problem.handles",
        angles="angles",
        alone="[[bend(a, m).vertices for m in materials[:2]] for a in angles[:2]]",
        slope="by_gradient",
        difference="by_differences",
        listed="listed.vertices",
    )
    assert got["ok"].all()
    np.testing.assert_allclose(
        got["listed"].reshape(got["poses"].shape), got["poses"], atol=1e-9 * np.ptp(got["rest"])
    )
    diagonal = np.linalg.norm(np.ptp(got["rest"], axis=0))
    assert np.abs(got["poses"][:2, :2] - got["alone"]).max() < 1e-3 * diagonal  # what solvers leave
    for poses, angle, left in zip(got["poses"], got["angles"], got["left"], strict=True):
        upper = got["handles"][got["rest"][got["handles"], 1] > 75]
        for pose, part in zip(poses, left, strict=True):
            turn, _ = motion(got["rest"][upper], pose[upper])
            np.testing.assert_allclose(turn, [0, 0, -angle], atol=1e-6)
            of_pose = volume(pose, got["faces"]) / volume(got["rest"], got["faces"])
            np.testing.assert_allclose(part, of_pose, rtol=PEER)
    np.testing.assert_allclose(got["slope"], got["difference"], rtol=0.05)


@pytest.mark.slow
def test_paths_and_animation(run):
    got = run(
        "10_paths_and_animation",
        rest="mesh.vertices",
        at_once="at_once.vertices",
        half="path.vertices[17]",
        ok="path.ok",
        waved="wave.ok",
    )
    rest = got["rest"]
    assert got["ok"].all()
    assert got["waved"].all()
    diagonal = np.linalg.norm(np.ptp(rest, axis=0))
    assert np.abs(got["at_once"] - rest).max() < 1e-3 * diagonal
    # Half-way the end has turned by 180 degrees, and so have, together, two layers that are equally
    # far from the two ends.
    heights, layer = np.unique(rest[:, 1].round(6), return_inverse=True)
    flat, turned = (pose[:, 0] + 1j * pose[:, 2] for pose in (rest, got["half"]))
    sums = [np.sum((turned * flat.conj())[layer == k]) for k in range(len(heights))]
    angle = np.abs(np.degrees(np.unwrap(np.angle(sums))))
    np.testing.assert_allclose(angle + angle[::-1], 180, atol=3)
