"""Docstrings as Markdown: names in backticks become links, examples blocks of code.

In a terminal they read as they are written. `rings` in single backticks is a name of jaxdeform;
``r = 1`` in double ones is code.
"""

import ast
import re
import textwrap

from griffe import Docstring, Extension, Module, Object


class Readable(Extension):
    """Rewrite every docstring once the package is read."""

    def on_package(self, *, pkg: Module, **_) -> None:
        """Rewrite the docstrings of all modules, classes, functions and attributes."""
        for member in pkg["_result.Result"].attributes.values():
            if not member.docstring:  # its value is the sentence
                member.docstring = Docstring(ast.literal_eval(str(member.value)), parent=member)
        _rewrite(pkg, names=set(pkg.exports or []), chosen=set(pkg["_mesh.select"].exports or []))


def _rewrite(thing: Object, names: set[str], chosen: set[str]) -> None:
    if thing.docstring:
        thing.docstring.value = as_markdown(thing.docstring.value, names, chosen)
    for member in thing.members.values():
        if not member.is_alias:
            _rewrite(member, names, chosen)


def as_markdown(text: str, names: set[str], chosen: set[str]) -> str:
    """Return a docstring as Markdown, given the names of jaxdeform and of jaxdeform.select."""

    def link(found: re.Match) -> str:
        name = found[1]
        if name.split(".")[0] in names:
            return f"[`{name}`][jaxdeform.{name}]"
        return f"[`{name}`][jaxdeform.select.{name}]" if name in chosen else found[0]

    def block(found: re.Match) -> str:
        return f"**Example**\n\n```pycon\n{textwrap.dedent(found[1]).strip()}\n```"

    text = re.sub(r"^- ([\w, ]+): ", r"- **\1**: ", text, flags=re.MULTILINE)
    text = re.sub(r"^Example:\n((?:(?: {4}.*)?\n?)+)", block, text, flags=re.MULTILINE)
    return re.sub(r"(?<!`)`([\w.]+)`(?!`)", link, text)
