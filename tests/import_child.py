"""Import all of jaxdeform, and print which state of the process is another one afterwards."""

import importlib
import locale
import logging
import multiprocessing
import os
import pkgutil
import signal
import sys
import threading

import jax
import numpy as np


def state() -> dict[str, object]:
    """Return what all of a process share, but for the filters of warnings: SciPy adds some."""
    mask = os.umask(0)
    os.umask(mask)
    return {
        "mask of files": mask,
        "folder": os.getcwd(),
        "environment": dict(os.environ),
        "path": list(sys.path),
        "signals": [signal.getsignal(number) for number in signal.valid_signals()],
        "hooks": (sys.excepthook, sys.displayhook, threading.excepthook),
        "threads": threading.active_count(),
        "start of processes": multiprocessing.get_start_method(allow_none=True),
        "locale": locale.setlocale(locale.LC_ALL),
        "log": (list(logging.root.handlers), logging.root.level),
        "errors of NumPy": np.geterr(),
        "printing of NumPy": np.get_printoptions(),
        "random numbers": np.random.get_state()[1].tolist(),
        "settings of JAX": dict(jax.config.values),
    }


if __name__ == "__main__":
    before = state()
    package = importlib.import_module("jaxdeform")
    for name in package.__all__:
        getattr(package, name)
    for module in pkgutil.walk_packages(package.__path__, "jaxdeform."):
        importlib.import_module(module.name)
    after = state()
    print(len([name for name in sys.modules if name.startswith("jaxdeform.")]), "modules")
    print([name for name in before if after[name] != before[name]])
