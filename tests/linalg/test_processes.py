"""A problem in other processes, threads and devices, and where there is only one CPU."""

import importlib.util
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers import ONE_CPU, one_cpu

CHILD = Path(__file__).with_name("child.py")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("processes")


@pytest.fixture(scope="module")
def run(folder):
    """Return a function that runs a task in a process of its own and returns what it wrote.

    They share a compilation cache, so that each program is compiled once.
    """

    def run(task: str, *numbers: int, before: tuple[str, ...] = (), **environment: str):
        file = folder / f"{task}.npy"
        variables = {
            "JAX_COMPILATION_CACHE_DIR": str(folder / "cache"),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            **environment,
        }
        subprocess.run(
            [*before, sys.executable, CHILD, task, file, *map(str, numbers)],
            env=os.environ | variables,
            check=True,
            timeout=600,
        )
        return np.load(file)

    return run


@pytest.fixture(scope="module")
def expected(run) -> np.ndarray:
    return run("write")


@pytest.mark.parametrize("task", ["unpickled", "leaves"])
def test_a_problem_from_a_file_is_itself(task, run, expected):
    np.testing.assert_array_equal(run(task), expected)


def test_programs_are_kept_for_the_next_process(run, expected, folder):
    """Those that call the host too: none is compiled again, so none is added."""
    before = {file.name for file in (folder / "cache").glob("*-cache")}
    assert any("_solve" in name for name in before)
    np.testing.assert_array_equal(run("here"), expected)
    assert {file.name for file in (folder / "cache").glob("*-cache")} == before


def test_a_process_may_end_while_deformations_run(run, expected):
    np.testing.assert_array_equal(run("hurried"), expected)


@pytest.mark.skipif(os.name == "nt", reason="Windows sends no SIGINT to a process of its own")
@pytest.mark.parametrize("kind", [1, 0, 2], ids=["deform", "estimate", "path"])
def test_ctrl_c_is_heard_while_jax_computes(run, kind):
    """And the process ends, though the deformation would go on for half an hour."""
    with pytest.raises(subprocess.CalledProcessError) as error:
        run("interrupted", kind)
    assert error.value.returncode == -signal.SIGINT


@pytest.mark.slow
@pytest.mark.parametrize("task", ["spawned", "forked", "cloudpickled", "sent_to_dask"])
def test_a_problem_in_another_process_is_itself(task, run, expected):
    needs = {"cloudpickled": "cloudpickle", "sent_to_dask": "distributed"}.get(task)
    if needs and importlib.util.find_spec(needs) is None:
        pytest.skip(f"needs {needs}")
    if task == "forked" and not hasattr(os, "fork"):
        pytest.skip("this system has no fork")
    np.testing.assert_array_equal(run(task), expected)


@pytest.mark.slow
@pytest.mark.parametrize("cpus", ["all", pytest.param("one", marks=ONE_CPU)])
def test_eight_threads(cpus, run, expected):
    before = one_cpu() if cpus == "one" else ()
    np.testing.assert_array_equal(run("threads", before=before), expected)


@pytest.mark.slow
@pytest.mark.parametrize("cpus", ["all", pytest.param("one", marks=ONE_CPU)])
def test_eight_devices(cpus, run, expected):
    before = one_cpu() if cpus == "one" else ()
    flags = "--xla_force_host_platform_device_count=8"
    np.testing.assert_allclose(run("devices", before=before, XLA_FLAGS=flags), expected, atol=1e-10)


@pytest.mark.slow
@ONE_CPU
@pytest.mark.parametrize(("size", "times"), [(30_000, 5), (200_000, 1)])
def test_one_cpu_is_enough(size, times, run):
    """A callback would now and then wait for ever for the thread that it occupies."""
    assert np.all(np.isfinite(run("large", size, times, before=one_cpu())))
