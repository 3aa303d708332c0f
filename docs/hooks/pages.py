"""Pages that are made from files elsewhere: README, CONTRIBUTING, CHANGELOG and the notebooks.

In the files links are paths, so that they also work in a folder and on a forge. Here they become
links between pages.
"""

import re
from pathlib import Path, PurePosixPath
from posixpath import normpath, relpath

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from nbconvert import MarkdownExporter

ROOT = Path(__file__).parents[2]
PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}
COPIES = ["CITATION.cff", "LICENSE"]


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages."""
    for name, page in PAGES.items():
        files.append(File.generated(config, page, content=(ROOT / name).read_text("utf-8")))
    for name in COPIES:
        files.append(File.generated(config, name, abs_src_path=str(ROOT / name)))
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        text, pictures = MarkdownExporter().from_filename(str(path))
        folder = f"{path.stem}_files"
        for name, content in pictures["outputs"].items():
            text = text.replace(f"]({name})", f"]({folder}/{name})")
            files.append(File.generated(config, f"notebooks/{folder}/{name}", content=content))
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=text))
    return files


def on_page_markdown(markdown: str, *, page, **_) -> str:
    """Turn paths of files into paths of pages."""
    made = {page: name for name, page in PAGES.items()}
    uri = page.file.src_uri
    source = made.get(uri, uri if uri.startswith("notebooks/") else f"docs/{uri}")
    home = PurePosixPath(source).parent
    here = PurePosixPath(uri).parent

    def link(found: re.Match) -> str:
        path = normpath(home / found[1])
        if path.endswith(".ipynb"):
            path = path.removesuffix(".ipynb") + ".md"
        target = PAGES.get(path, path.removeprefix("docs/"))
        return f"]({relpath(target, here)}{found[2] or ''})"

    return re.sub(r"\]\((?![\w+.-]+:|#)([^)#\s]+)(#[^)\s]*)?\)", link, markdown)
