"""House rules: imports go down the floors, every public name is explained, the README is true."""

import ast
import doctest
import functools
import graphlib
import importlib
import inspect
import pydoc
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from packaging.requirements import Requirement
from packaging.version import Version
from page_code import run_page

import jaxdeform as jd

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "jaxdeform"

# From the ground up. A module imports from lower floors, or from its own without a circle.
FLOORS = [
    ["_errors"],
    ["_arrays", "_checks", "_result"],
    ["_values"],
    ["_mesh"],
    ["_linalg"],
    ["_handles"],
    ["_deformation"],
    ["_baselines"],
    ["_estimation"],
    ["_plotting"],
    ["_apps"],
    ["__main__"],
]
FLOOR = {name: floor for floor, names in enumerate(FLOORS) for name in names}


def dotted(path: Path) -> str:
    return ".".join(["jaxdeform", *path.relative_to(PACKAGE).with_suffix("").parts])


FILES = {dotted(path): path for path in PACKAGE.rglob("*.py") if path.stem != "__init__"}
MODULES = sorted(FILES)


def imported(path: Path) -> set[str]:
    """Return the modules of the package that a file imports, also inside functions."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("jaxdeform"):
            inside = {f"{node.module}.{alias.name}" for alias in node.names}
            names |= {node.module} if node.module in FILES else inside
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names if alias.name.startswith("jaxdeform.")}
    return names


@pytest.mark.parametrize("name", MODULES)
def test_imports_only_go_down(name):
    floor = FLOOR.get(name.split(".")[1])
    assert floor is not None, f"give {name} a floor in this table (and in CONTRIBUTING)"
    above = {other for other in imported(FILES[name]) if FLOOR[other.split(".")[1]] > floor}
    assert not above


def test_imports_run_in_no_circle():
    graph = {name: imported(path) & set(FILES) for name, path in FILES.items()}
    list(graphlib.TopologicalSorter(graph).static_order())  # raises CycleError


PUBLIC = {name: getattr(jd, name) for name in jd.__all__}
PUBLIC |= {f"select.{name}": getattr(jd.select, name) for name in jd.select.__all__}


@pytest.mark.parametrize("name", sorted(PUBLIC))
def test_every_public_name_is_explained(name):
    thing = PUBLIC[name]
    text = inspect.getdoc(thing)
    assert text, f"{name} has no docstring"
    if inspect.isfunction(thing):
        assert "Example:" in text
        assert ">>>" in text
    if inspect.isclass(thing):
        for member, value in vars(thing).items():
            if inspect.isfunction(value) and not member.startswith("_"):
                assert inspect.getdoc(value), f"{name}.{member} has no docstring"


@pytest.mark.parametrize("name", [name for name in sorted(PUBLIC) if inspect.isclass(PUBLIC[name])])
def test_help_tells_of_every_field(name):
    """A string below a field is in the source alone; a list in the docstring is in help() too."""
    thing = PUBLIC[name]
    said = pydoc.plain(pydoc.render_doc(thing))
    listed = re.findall(r"^ \|  - (\w[\w, ]*): \S", said, re.MULTILINE)
    told = {field for fields in listed for field in fields.split(", ")}
    fields = {field for each in thing.__mro__ for field in vars(each).get("__annotations__", {})}
    assert {field for field in fields if not field.startswith("_")} <= told
    for member, value in vars(thing).items():
        if isinstance(value, property | functools.cached_property) and member[0] != "_":
            assert inspect.getdoc(value), f"{name}.{member} has no docstring"


def test_only_public_jax_is_used():
    """jax.core keeps Tracer as a public name; jax.extend and jax.interpreters promise nothing."""
    private = re.compile(r"jax\.(_src|extend|interpreters)\b|jax\.core\.(?!Tracer\b)")
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom):
                # The last point tells "from jax import core" too.
                names = [f"{node.module}.{alias.name}." for alias in node.names]
            elif isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            else:
                names = [ast.unparse(node)] if isinstance(node, ast.Attribute) else []
            wrong = [name for name in names if private.match(name)]
            assert not wrong, f"{path.name} uses {wrong}"


def test_no_module_leaks_into_the_public_face():
    things = {name: getattr(jd, name) for name in {*vars(jd), *dir(jd)}}  # dir: not loaded yet
    modules = {name for name, thing in things.items() if inspect.ismodule(thing)}
    ours = {name for name in modules if things[name].__name__.startswith("jaxdeform")}
    assert {name for name in ours if not name.startswith("_")} == {"select", "shapes"}


def code_lines(node: ast.FunctionDef, text: str) -> int:
    """Count the lines of a function without its docstring, comments and empty lines."""
    lines = text.splitlines()[node.lineno - 1 : node.end_lineno]
    code = sum(bool(line.strip()) and not line.strip().startswith("#") for line in lines)
    docstring = ast.get_docstring(node, clean=False)
    return code - len(docstring.splitlines()) if docstring else code


@pytest.mark.parametrize("name", MODULES)
def test_files_and_functions_stay_small(name):
    text = FILES[name].read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 350, "one trade a file"
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef):
            assert code_lines(node, text) <= 60, f"{node.name}: one thought a function"


def test_public_names_are_sorted_and_there():
    assert len(set(jd.__all__)) == len(jd.__all__)
    for module in (jd, jd.select, jd.shapes):
        assert dir(module) == sorted(module.__all__)
    public = {
        name
        for name, thing in vars(jd).items()
        if (inspect.isfunction(thing) or inspect.isclass(thing)) and not name.startswith("_")
    }
    assert public <= set(jd.__all__)


@pytest.mark.slow
@pytest.mark.parametrize("name", MODULES)
def test_examples_run(name):
    """Minutes, nearly all of it JAX compiling."""
    found = doctest.testmod(importlib.import_module(name))
    assert found.failed == 0


README = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_readme_python_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # Of the commands, some name files of the reader.
    blocks = re.sub(r"^```sh\n.*?^```", "", README, flags=re.DOTALL | re.MULTILINE)
    names = run_page(blocks, "README.md")
    # What the text says comes out. The pose is that of the solver's tolerance.
    np.testing.assert_allclose(names["fit"].rigidity, [0.01, 30.0], rtol=0.02)
    low, high = names["fit"].interval.T
    assert (low < [0.01, 30.0]).all()
    assert (high > [0.01, 30.0]).all()
    assert jd.load_rigidity(tmp_path / "bent.ply").shape == (722,)


@pytest.mark.parametrize("name", ["demo", "tests"])
def test_readme_commands_name_what_is_there(name):
    """The fresh environment itself is made in continuous integration."""
    (line,) = re.findall(rf"<!-- {name} -->\n```sh\n(.*)\n```", README)
    words = shlex.split(line)
    assert (ROOT / words[words.index("--constraint") + 1]).exists()
    extras = re.search(r"\.\[([\w,]+)\]", line)
    assert extras
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    for extra in extras[1].split(","):
        assert re.search(rf"^{extra} = \[", project, re.MULTILINE)
    assert line.endswith({"demo": ".venv/bin/jaxdeform demo", "tests": "python -m pytest"}[name])


def test_readme_command_line_is_the_real_one():
    from jaxdeform._apps.cli import app

    commands = {command.callback.__name__ for command in app.registered_commands}
    (block,) = re.findall(r"```sh\n(jaxdeform inspect.*?)```", README, re.DOTALL)
    for line in block.splitlines():
        assert line.split()[1] in commands, line


def test_citation_has_the_version_of_the_package():
    (cited,) = re.findall(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert cited == jd.__version__


def test_the_oldest_versions_are_the_lower_bounds():
    """Else nobody has tried what the bounds promise, or pip refuses to install them."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    lines = (ROOT / "constraints" / "oldest.txt").read_text().splitlines()
    oldest = dict(line.split("==") for line in lines if "==" in line)
    for text in [*project["dependencies"], *extras["viewer"], *extras["batch"], *extras["test"]]:
        needed = Requirement(text)
        if needed.name == "jaxdeform":
            continue
        (least,) = [Version(s.version) for s in needed.specifier if s.operator == ">="]
        assert needed.name in oldest, f"{text}: constraints/oldest.txt does not name it"
        assert Version(oldest[needed.name]) == least, text


def test_importing_loads_what_is_used_and_no_more():
    """Each public name loads its own; the rest is for estimates, pictures, files, clusters."""
    parts = ["stats", "optimize", "spatial", "interpolate", "sparse.csgraph", "sparse.linalg"]
    heavy = [*(f"scipy.{part}" for part in parts), "jaxopt", "optimistix", "lineax", "pyvista"]
    heavy += ["typer", "zarr", "dask"]
    program = f"""
import sys, jaxdeform as jd
print(*[x for x in ("jax", "numpy") if x in sys.modules])
jd.precompute, jd.deform
print(*[x for x in {heavy} if x in sys.modules])
"""
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert run.stdout.split() == []


def test_no_import_changes_the_process():
    child = Path(__file__).with_name("import_child.py")
    run = subprocess.run([sys.executable, child], capture_output=True, text=True, check=True)
    modules, changed = run.stdout.splitlines()
    assert int(modules.split()[0]) > 100
    assert changed == "[]"
