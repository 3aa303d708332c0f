"""Runs the blocks of code on a page, and compares what they say with what the page says."""

import contextlib
import io
import os
import re
import shlex
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxdeform as jd
from jaxdeform._apps.cli import main

_BLOCK = re.compile(r"^```(python|sh|text)\n(.*?)^```", re.DOTALL | re.MULTILINE)
_NUMBER = r"[-+]?(?:\d+\.?\d*(?:e[-+]?\d+)?|inf\b|nan\b)"


def run_page(text: str, name: str, numbers: float = 0.02) -> dict:
    """Run the blocks of a page in order, and return the names that are left.

    A block in Python finds the names of those before it. Of a block for the shell, the lines that
    begin with ``jaxdeform`` run. A block of text says what the block before it printed, or its
    error: ``...`` stands for anything, and numbers may differ by the given fraction.
    """
    names: dict = {"__name__": "page"}
    said = None
    # As a user has JAX, not as the other tests have it.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        for kind, code in _BLOCK.findall(text):
            if kind == "text":
                assert said is not None, f"{name}: says what no block printed: {code}"
                compare(code, said, name, numbers)
                said = None
            else:
                _check_no_error(said, name)
                said = _python(code, name, names) if kind == "python" else _shell(code)
    _check_no_error(said, name)
    return names


def _check_no_error(said: str | None, name: str) -> None:
    assert not (said or "").startswith(("InputError: ", "jaxdeform: ")), f"{name}: {said}"


def _python(code: str, name: str, names: dict) -> str:
    with contextlib.redirect_stdout(io.StringIO()) as out:
        try:
            exec(compile(code, name, "exec"), names)
        except jd.InputError as error:
            notes = [note for note in getattr(error, "__notes__", []) if "JAX" not in note]
            return "\n".join([f"InputError: {error}", *notes])
    return out.getvalue()


def _shell(code: str) -> str:
    """Run the lines that call jaxdeform in this process, and return what they print."""
    said = ""
    for line in code.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        if words[:1] == ["jaxdeform"]:
            out, fault = io.StringIO(), io.StringIO()
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr("sys.argv", words)
                patch.setenv("COLUMNS", "120")
                with contextlib.redirect_stdout(out), contextlib.redirect_stderr(fault):
                    try:
                        main()
                    except SystemExit as end:
                        if end.code:
                            return fault.getvalue()
            said += out.getvalue()
    return said


def compare(expected: str, said: str, name: str, numbers: float) -> None:
    """Fail unless the text is as expected."""
    pieces = re.split(rf"({_NUMBER}|\.\.\.|\s+)", expected.strip())
    pattern, wanted = "", []
    for piece in pieces:
        if piece == "...":
            pattern += ".*?"
        elif not piece.strip():
            pattern += r"\s*" if piece else ""
        elif re.fullmatch(_NUMBER, piece):
            pattern += f"({_NUMBER})"
            wanted.append(float(piece))
        else:
            pattern += re.escape(piece)
    found = re.fullmatch(rf"\s*{pattern}\s*", said, re.DOTALL)
    assert found, f"{name} says:\n{expected}\nbut it is:\n{said}"
    got = [float(number) for number in found.groups()]
    np.testing.assert_allclose(got, wanted, rtol=numbers, atol=1e-12, err_msg=said)


def page_names(root: Path) -> list[str]:
    """Return the pages of the docs, as paths from their folder."""
    folder = root / "docs"
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.md"))


@contextlib.contextmanager
def inside(folder: Path):
    """Work in a folder."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)
