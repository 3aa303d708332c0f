"""How the tests of the apps run the command line."""

import sys

import pytest

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
