r"""Formulas as MathML, which browsers draw by themselves: no script, no font, no network.

``$...$`` in a line and ``$$...$$`` on its own, in LaTeX, outside of code. Each one waits under a
number that Markdown leaves alone, and is put in once the page is HTML.
"""

import re

from latex2mathml.converter import convert

# Code first, so that a dollar in it is none of ours.
_PIECES = re.compile(
    r"(?P<code>^(?P<fence>`{3,}).*?^(?P=fence)`*\s*$|`[^`\n]+`)"
    r"|\$\$(?P<block>.+?)\$\$"
    r"|(?<![\\\w$])\$(?P<inline>[^$\n]+?)\$(?!\w)",
    re.DOTALL | re.MULTILINE,
)


def on_page_markdown(markdown: str, *, page, **_) -> str:
    """Take the formulas out."""
    page.formulas = []

    def number(found: re.Match) -> str:
        if found["code"]:
            return found[0]
        kind = "block" if found["block"] else "inline"
        page.formulas.append(convert(found[kind].strip(), display=kind))
        return f"FORMULA{len(page.formulas) - 1}ALUMROF"

    return _PIECES.sub(number, markdown)


def on_page_content(html: str, *, page, **_) -> str:
    """Put the formulas in."""
    return re.sub(r"FORMULA(\d+)ALUMROF", lambda found: page.formulas[int(found[1])], html)
