"""The command deform with vertices chosen by expressions: the same as the calls in Python."""

import jax
import numpy as np
import pytest
from helpers import EXACT
from PIL import Image

import jaxdeform as jd


@pytest.fixture
def deform(run, monkeypatch, tmp_path):
    """Return a function that runs ``deform`` on a bar 1 high: (exit code, stdout, stderr)."""
    bar = jd.shapes.bar()
    jd.save_mesh(tmp_path / "bar.obj", jd.Mesh(bar.vertices / 151, bar.faces))
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: run("deform", "bar.obj", "-o", "out.obj", *arguments)


ENDS = "--fix", "y<0.1", "--move", "y>0.9"
LIFT = *ENDS, "--translate", 0, 0.2, 0
TURN = *LIFT, "--rotate", "z", 60


def ends(about=None):
    """Return the mesh of the file, its handles, and where --rotate and --translate put them."""
    mesh = jd.load_mesh("bar.obj")
    y = mesh.vertices[:, 1]
    handles = np.flatnonzero((y < 0.1) | (y > 0.9))
    up = y[handles] > 0.9
    targets = mesh.vertices[handles]
    center = targets[up].mean(axis=0) if about is None else np.array(about)
    c, s = np.cos(np.pi / 3), np.sin(np.pi / 3)
    turned = (targets[up] - center) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + center
    targets[up] = turned + np.array([0, 0.2, 0])
    return mesh, handles, targets


def test_the_command_of_the_readme(deform):
    code, out, err = deform(
        *TURN, "--stiff", "y>0.5", 30, "--rings", 2, "--method", "material",
        "--picture", "out.png", "--steps", 20,
    )  # fmt: skip
    assert (code, err) == (0, "")
    assert out.startswith("fixed: 97 vertices, moved: 97 vertices\n")
    assert "after 20 steps" in out
    mesh, handles, targets = ends()
    problem = jd.precompute(mesh, handles, cells=jd.rings(mesh, 2))
    rigidity = np.array(jd.rigidity_from_material(problem, 0.2))
    rigidity[mesh.vertices[:, 1] > 0.5] = 30.0
    want = jd.deform(problem, targets, rigidity, solver=jd.Alternating(20))
    np.testing.assert_allclose(jd.load_mesh("out.obj").vertices, want.vertices, atol=1e-8)
    # The picture is that of the same pose and the same colours.
    jd.render(
        "want.png", mesh, [mesh.vertices, np.asarray(want.vertices)],
        titles=["rest", "deformed"], values=[None, rigidity], handles=handles,
    )  # fmt: skip
    drawn, expected = (np.asarray(Image.open(name), int) for name in ("out.png", "want.png"))
    assert drawn.shape == expected.shape
    assert (np.abs(drawn - expected).max(axis=2) > 8).mean() < 1e-3


@pytest.mark.parametrize("method", ["arap", "rc-arap", "sr-arap", "laplacian"])
def test_other_methods_are_those_of_the_documentation(deform, method):
    about = (0.0, 0.5, 0.1)
    own = {"rc-arap": ("--rings", 2), "sr-arap": ("--alpha", 0.5)}.get(method, ())
    steps = () if method == "laplacian" else ("--steps", 20)
    code, out, err = deform(*TURN, "--about", *about, "--method", method, *own, *steps)
    assert (code, err) == (0, "")
    mesh, handles, targets = ends(about)
    if method == "laplacian":
        want = jd.laplacian_editing(mesh, handles, targets)
    elif method == "sr-arap":
        want = jd.sr_arap(mesh, handles, targets, 0.5, steps=20).vertices
    else:
        cells = jd.spokes(mesh) if method == "arap" else jd.rings(mesh, 2)
        problem = jd.precompute(mesh, handles, cells=cells)
        solver = jd.Alternating(20)
        # Any rigidity: cells that rotate have no strain.
        want = jd.deform(problem, targets, 3.0, local=jd.RotationFit(), solver=solver).vertices
    np.testing.assert_allclose(jd.load_mesh("out.obj").vertices, want, atol=1e-8)
    assert ("energy" in out) == (method != "laplacian")


def test_expressions_of_fix_join_and_the_last_stiff_wins(deform):
    where = "--fix", "y < 0.05", "--fix", "v < 0.1 and x > 0", "--move", "y > 0.9 and z > 0"
    code, out, err = deform(
        *where, "--translate", 0.1, -0.05, 0, "--rigidity", 0.1, "--stiff", "y > 0.3", 2,
        "--stiff", "y > 0.6", 5e-1, "--steps", 1, "-o", "out.ply",
    )  # fmt: skip
    assert (code, err) == (0, "")
    mesh = jd.load_mesh("bar.obj")
    x, y, z = mesh.vertices.T
    fixed = (y < 0.05) | ((y / y.max() < 0.1) & (x > 0))
    moved = (y > 0.9) & (z > 0)
    assert f"fixed: {fixed.sum()} vertices, moved: {moved.sum()} vertices" in out
    pose = jd.load_mesh("out.ply").vertices
    np.testing.assert_allclose(pose[fixed], mesh.vertices[fixed], atol=EXACT)
    np.testing.assert_allclose(
        pose[moved], mesh.vertices[moved] + np.array([0.1, -0.05, 0]), atol=EXACT
    )
    want = np.where(y > 0.6, 0.5, np.where(y > 0.3, 2.0, 0.1))
    np.testing.assert_array_equal(jd.load_rigidity("out.ply"), want)


CARET = "--fix: found '&' (write and) instead of a sign, 'and', 'or' or the end, at column 7"
MISTAKES = {
    "no vertices are chosen: give --fix EXPR and --move EXPR with --rotate or --translate, or": [],
    "nothing moves: give --move EXPR with --rotate or --translate": ["--fix", "y<0.1"],
    "nothing moves: give": ["--rotate", "z", 60],
    "--move needs --rotate AXIS DEGREES, --translate X Y Z, or both": [*ENDS],
    "--about is the centre of a rotation: give --rotate": [*LIFT, "--about", 0, 0, 0],
    "--fix and --handles are two ways to choose vertices": [*LIFT, "--handles", "h.json"],
    "--translate and --handles are two": ["--handles", "h.json", "--translate", 0, 0, 1],
    "--motion is the .def file of a .sel file": [*LIFT, "--motion", "h.def"],
    "--fix and --move both choose 97 vertices (vertex ": [*LIFT, "--fix", "y > 0.9"],
    "--move is given twice: join expressions by 'or'": [*LIFT, "--move", "y<0.5"],
    "--translate is given twice": [*LIFT, "--translate", 1, 1, 1],
    "--move is given twice: join": [*LIFT, "--move=y<0.5"],
    "--rotate: axis is 'q': give 'x', 'y', 'z'": [*LIFT, "--rotate", "q", 60],
    "--rotate: degrees is inf": [*LIFT, "--rotate", "x", "inf"],
    "--translate: offset is": [*ENDS, "--translate", 0, "nan", 0],
    "--fix: 'y > 9' holds for no vertex: x runs from -0.09934 to 0.09934, y from 0 to 1, z": [
        *LIFT, "--fix", "y > 9",
    ],
    "--move: 'y < 0' holds for no vertex": ["--move", "y < 0", "--rotate", "x", 9],
    "--stiff: 'soft' is not a number: give --stiff EXPR VALUE": [*LIFT, "--stiff", "y<1", "soft"],
    "--stiff: 'y<1' is not a number": [*LIFT, "--stiff", "y<1"],
    "--stiff: rigidity is -1.0": [*LIFT, "--stiff", "y<1", -1],
    "--stiff: 'x > 9' holds for no vertex": [*LIFT, "--stiff", "x > 9", 1],
    "--rigidity means nothing to --method arap": [*LIFT, "--method", "arap", "--rigidity", 1],
    "--rings means nothing to --method arap": [*LIFT, "--method", "arap", "--rings", 2],
    "--stiff means nothing to --method rc-arap": [
        *LIFT, "--method", "rc-arap", "--stiff", "y<1", 3,
    ],
    "--normals means nothing to --method sr-arap": [*LIFT, "--method", "sr-arap", "--normals"],
    "--alpha means nothing to --method rc-arap": [*LIFT, "--method", "rc-arap", "--alpha", 0],
    "--alpha is -1.0: give a finite number, 0 or more": [
        *LIFT, "--method", "sr-arap", "--alpha", -1,
    ],
    "--normals means nothing to --method laplacian": [
        *LIFT, "--method", "laplacian", "--normals",
    ],
    f"{CARET} of 'y<0.1 &'\n    y<0.1 &\n          ^\n": [*LIFT, "--fix", "y<0.1 &"],
}  # fmt: skip


@pytest.mark.parametrize("message", MISTAKES)
def test_a_mistake_is_told_before_any_work(deform, monkeypatch, message):
    for name in ("precompute", "laplacian_editing"):
        monkeypatch.setattr(jd, name, lambda *_, **__: pytest.fail("began to work"))
    code, out, err = deform(*MISTAKES[message])
    assert (code, out) == (2, "")
    assert err.startswith(f"jaxdeform: {message}")
    assert err.count("\n") == 1 + 2 * ("^" in message)


@pytest.mark.parametrize(
    "words", [("--method", "cage"), ("--stiff",), ("--rotate", "z"), ("--translate", 0, 1, "up")]
)
def test_wrong_usage_names_the_option(deform, words):
    code, out, err = deform(*words)
    assert (code, out) == (2, "")
    assert f"'{words[0]}'" in err
    assert "Traceback" not in err


def test_a_file_and_expressions_count_the_same(deform, tmp_path):
    (tmp_path / "h.json").write_text(
        """{"handles": [{"where": "y < 0.1"}, {"where": "y > 0.9", "translation": [0, 0.2, 0]}]}"""
    )
    _, by_file, _ = deform("--handles", "h.json", "--rigidity", 1, "--steps", 1)
    first = jd.load_mesh("out.obj").vertices
    _, by_place, _ = deform(*LIFT, "--rigidity", 1, "--steps", 1)
    counts = "fixed: 97 vertices, moved: 97 vertices"
    assert by_file.split("\n")[0] == by_place.split("\n")[0] == counts
    np.testing.assert_array_equal(jd.load_mesh("out.obj").vertices, first)
    assert jax.config.jax_enable_x64


def test_a_rotation_of_what_lies_on_its_axis_is_refused(deform):
    """One vertex, or a line of them along z."""
    mesh = jd.load_mesh("bar.obj")
    x, y, z = mesh.vertices[300]
    one = f"x>{x - 1e-4} and x<{x + 1e-4} and y>{y - 1e-4} and y<{y + 1e-4}"
    alone = f"{one} and z>{z - 1e-4} and z<{z + 1e-4}"
    for chosen in (alone, one):
        for still in ([], ["--translate", 0, 0, 0]):
            code, _, err = deform("--fix", "y<0.1", "--move", chosen, "--rotate", "z", 60, *still)
            assert code == 2
            assert "on the axis, which goes through the middle, so nothing moves" in err
            assert ("the 1 vertex of --move lies on" in err) == (chosen == alone)
    code, _, err = deform(
        "--fix", "y<0.1", "--move", alone, "--rotate", "z", 60, "--about", 0, 0, 0, "--steps", 2
    )
    assert (code, err) == (0, "")


@pytest.mark.filterwarnings("always:negative weights")
def test_a_warning_is_a_line_of_the_command(run, tmp_path):
    """Without the line of Python that it comes from. The bar is sheared, for obtuse angles."""
    bar = jd.shapes.bar()
    jd.save_mesh(
        tmp_path / "m.off", jd.Mesh(bar.vertices @ [[1, 0, 0], [1.5, 1, 0], [0, 0, 1]], bar.faces)
    )
    code, _, err = run(
        "deform", tmp_path / "m.off", "-o", tmp_path / "o.off", "--fix", "y<6",
        "--move", "y>145", "--translate", 0, 9, 0, "--steps", 2,
    )  # fmt: skip
    assert code == 0
    assert err.startswith("jaxdeform: negative weights (obtuse angles) leave the energy of 196")
    assert len(err.splitlines()) == 1
