"""The docs are whole: every public name has its place, every link its end, the site builds."""

import importlib.util
import inspect
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import typer

import jaxdeform as jd
from jaxdeform._apps.cli import app

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted([*ROOT.glob("*.md"), *DOCS.rglob("*.md")])
HAS_MKDOCS = importlib.util.find_spec("mkdocs") is not None


def without_code(text: str) -> str:
    return re.sub(r"^```.*?^```|`[^`\n]*`", "", text, flags=re.DOTALL | re.MULTILINE)


def documented() -> list[str]:
    """Return the names that the pages of the reference show."""
    pages = (page.read_text(encoding="utf-8") for page in (DOCS / "reference").glob("*.md"))
    return [name for page in pages for name in re.findall(r"^::: jaxdeform\.(\S+)", page, re.M)]


def test_the_reference_shows_every_public_name_once():
    assert sorted(documented()) == sorted(jd.__all__)


def test_the_reference_shows_every_option_of_the_command_line():
    page = (DOCS / "reference" / "command-line.md").read_text(encoding="utf-8")
    sections = dict(re.findall(r"^## jaxdeform (\w+).*?$(.*?)(?=^## |\Z)", page, re.M | re.DOTALL))
    command = typer.main.get_command(app)
    assert set(sections) == set(command.commands)
    for name, text in sections.items():
        shown = set(re.findall(r"^\| `(--[\w-]+)`", text, re.M))
        options = [p for p in command.commands[name].params if p.param_type_name == "option"]
        assert shown == {option.opts[0] for option in options} - {"--help"}, name


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page, as mkdocs and the forges make them from headings."""
    text = page.read_text(encoding="utf-8")
    names = {f"jaxdeform.{name}" for name in re.findall(r"^::: jaxdeform\.(\S+)", text, re.M)}
    text = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    for heading in re.findall(r"^#+ (.+)$", text, re.M):
        plain = re.sub(r"[^\x00-\x7f]", "", re.sub(r"[`*]", "", heading)).strip().lower()
        names.add(re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", plain).strip()))
    return names


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_link_has_an_end(page):
    text = without_code(page.read_text(encoding="utf-8"))
    for path, anchor in re.findall(r"\]\(([^)#\s]*)(?:#([^)\s]+))?\)", text):
        if "://" in path:
            continue
        target = page.parent / path if path else page
        assert target.exists(), f"{page.name} links {path}"
        if anchor and target.suffix == ".md":
            assert anchor in anchors(target), f"{page.name} links {path}#{anchor}"
    for name in re.findall(r"\]\[jaxdeform\.([\w.]+)\]", text):
        assert name.split(".")[0] in jd.__all__, f"{page.name} links {name}"


def test_a_link_in_a_docstring_is_a_name_of_the_package():
    """Single backticks are links on the site; code stands in double ones."""
    for name in jd.__all__:
        text = inspect.getdoc(getattr(jd, name)) or ""
        for linked in re.findall(r"(?<!`)`([^`]+)`(?!`)", text):
            assert linked.split(".")[0] in jd.__all__, f"{name} links {linked}"


def test_no_docstring_has_roles_that_show():
    for path in (ROOT / "jaxdeform").rglob("*.py"):
        assert not re.search(r":\w+:`", path.read_text(encoding="utf-8")), path.name


def test_troubleshooting_knows_every_result():
    page = (DOCS / "troubleshooting.md").read_text(encoding="utf-8")
    (table,) = re.findall(r"^## What `out.result` says$(.*?)^## ", page, re.M | re.DOTALL)
    rows = {name for row in re.findall(r"^\| (`.*?) \|", table, re.M) for name in row.split(", ")}
    assert all(hasattr(jd.Result, name.strip("`")) for name in rows)
    assert len(rows) == len(jd.Result)


@pytest.mark.slow
@pytest.mark.skipif(not HAS_MKDOCS, reason="needs the docs extra")
def test_the_site_builds_without_a_network(tmp_path):
    """Strictly, and what it shows is on it: nothing is fetched from elsewhere."""
    for name in ["docs", "notebooks", "jaxdeform", "mkdocs.yml"]:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, tmp_path / name)
    for name in [*(page.name for page in ROOT.glob("*.md")), "CITATION.cff", "LICENSE"]:
        shutil.copy(ROOT / name, tmp_path / name)
    offline = [sys.executable, "-c", _OFFLINE, "build", "--strict", "--site-dir", "out"]
    done = subprocess.run(offline, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    site = tmp_path / "out"
    for page in site.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        fetched = re.findall(r"<(?:script|img|iframe)[^>]*src=[\"']?(?:https?:)?//", text)
        fetched += re.findall(r"<link[^>]*stylesheet[^>]*href=[\"']?(?:https?:)?//", text)
        assert not fetched, page
        assert not re.search(r"FORMULA\d|<p>[^<]*&gt;&gt;&gt;", text), page
    assert "<math" in (site / "mathematics" / "index.html").read_text(encoding="utf-8")
    assert 'id="jaxdeform.deform"' in (site / "reference/deforming/index.html").read_text("utf-8")
    assert list((site / "notebooks").rglob("*.png"))


# Whoever asks for an address finds none.
_OFFLINE = """
import socket
def refuse(*given, **named):
    raise OSError("the network is off")
socket.getaddrinfo = socket.create_connection = socket.socket.connect = refuse
from mkdocs.__main__ import cli
cli()
"""
