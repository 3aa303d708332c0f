"""A batch in chunks, on several devices and processes: every member as if alone."""

import importlib.util
import os
import socket
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ONE_CPU, one_cpu

import jaxdeform as jd
from jaxdeform._deformation.batch import MEMORY, _size_of_chunk

CHILD = Path(__file__).with_name("batch_child.py")
_spec = importlib.util.spec_from_file_location("batch_child", CHILD)
batch_child = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(batch_child)
# Chunks of two members of this plate.
SMALL = 40 * 64 * 8 * 2 * 2  # of 28 vertices, in arrays of 64


@pytest.fixture(scope="module")
def plate():
    return batch_child.batch()


@pytest.fixture(scope="module")
def alone(plate) -> list[jd.Solution]:
    problem, targets, rigidity = plate
    return [jd.deform(problem, t, r) for t, r in zip(targets, rigidity, strict=True)]


def test_members_are_as_if_alone(plate, alone):
    """In chunks that do not divide the batch; told of and yielded in order."""
    told = []
    out = jd.deform_batch(*plate, memory=SMALL, progress=lambda *x: told.append(x))
    assert told == [(2, 11), (4, 11), (6, 11), (8, 11), (10, 11), (11, 11)]
    assert bool(out.ok.all())
    for k, one in enumerate(alone):
        np.testing.assert_allclose(out.vertices[k], one.vertices, atol=1e-10)
        np.testing.assert_allclose(out.transforms[k], one.transforms, atol=1e-9)
        np.testing.assert_allclose(out.energy[k, -1], one.energy[-1], rtol=1e-10, atol=1e-10)
    seen = []
    for members, part in jd.deform_in_chunks(*plate, memory=SMALL):
        np.testing.assert_array_equal(part.vertices, out.vertices[members])
        seen += range(members.start, members.stop)
    assert seen == list(range(11))


@pytest.mark.slow
def test_what_is_the_same_for_all_is_given_once(plate, tmp_path):
    problem, targets, rigidity = plate
    field = np.full((1, problem.n_vertices), rigidity[3])
    start = np.asarray(problem.mesh.vertices)
    want = jd.deform_batch(
        problem,
        targets[:2],
        np.repeat(field, 2, axis=0),
        start=np.stack([start, start]),
        memory=SMALL,
    )
    np.save(tmp_path / "targets.npy", targets[:2])
    mapped = np.load(tmp_path / "targets.npy", mmap_mode="r")
    for lam in (field, rigidity[3], rigidity[[3, 3]]):
        got = jd.deform_batch(problem, mapped, lam, start=start, memory=SMALL)
        np.testing.assert_array_equal(got.vertices, want.vertices)
    one = jd.deform_batch(problem, targets[1], rigidity[[3]], start=start, memory=SMALL)
    np.testing.assert_allclose(one.vertices[0], want.vertices[1], atol=1e-10)


def test_a_bad_member_does_not_end_the_others(plate, alone):
    problem, targets, rigidity = plate
    targets, rigidity = targets.copy(), rigidity.copy()
    targets[2, 0, 1], rigidity[5], rigidity[7] = np.inf, -1.0, np.nan
    out = jd.deform_batch(problem, targets, rigidity, memory=SMALL)
    bad = np.asarray(out.result == jd.Result.bad_input)
    assert np.flatnonzero(bad).tolist() == [2, 5, 7]
    for k in np.flatnonzero(~bad):
        np.testing.assert_allclose(out.vertices[k], alone[k].vertices, atol=1e-10)
    with pytest.raises(Exception, match="Not solved"):
        jd.deform_batch(problem, targets, rigidity, memory=SMALL, throw=True)


def test_many_members_go_in_two_chunks_and_all_in_as_many_as_fit(plate):
    problem = plate[0]
    devices = jax.device_count()
    assert _size_of_chunk(problem, 191 * devices, MEMORY) == 191 * devices
    assert _size_of_chunk(problem, 192 * devices, MEMORY) == 96 * devices
    assert _size_of_chunk(problem, 1000 * devices, SMALL) < 192 * devices


@dataclass(frozen=True)
class Halving:
    """Rotations by a loop that begins with zeros, which are the same for all members."""

    def minimize(self, c, b, rigidity):
        rotation = jd.RotationFit().minimize(c, b, rigidity)
        halve = lambda _, t: 0.5 * (t + rotation)  # noqa: E731
        return jax.lax.fori_loop(0, 60, halve, jnp.zeros(rotation.shape))

    def with_implicit_derivative(self, t, c, b, rigidity):
        return jd.RotationFit().with_implicit_derivative(t, c, b, rigidity)

    def energy(self, t, c, b, rigidity):
        return jd.RotationFit().energy(t, c, b, rigidity)


@pytest.mark.parametrize("local", [jd.LBFGS(max_steps=5), Halving()])
def test_local_steps_may_loop_as_they_like(local):
    mesh = jd.shapes.square()
    problem = jd.precompute(mesh, [0, 1, 2, 6, 7, 8])
    rest = mesh.vertices[problem.handles]
    targets = np.stack([jd.twist(rest, degrees, along="y") for degrees in (20.0, 60.0)])
    given = {"local": local, "solver": jd.Alternating(2)}
    out = jd.deform_batch(problem, targets, 0.5, **given)
    for got, member in zip(out.vertices, targets, strict=True):
        np.testing.assert_allclose(
            got, jd.deform(problem, member, 0.5, **given).vertices, atol=1e-10
        )


def test_what_does_not_fit_together_is_named(plate):
    problem, targets, rigidity = plate
    n = problem.n_vertices
    for message, arguments in {
        rf"rigidity has {n} members, but targets have 11: give as many.*\(1, {n}\)": (
            targets,
            np.ones(n),
        ),
        "rigidity has 11 members, but targets have 3": (targets[:3], rigidity),
        r"targets have shape \(11, 7, 3\): give \(batch, 8, 3\)": (targets[:, :7], rigidity),
        r"targets have shape \(0, 8, 3\).*at least one": (targets[:0], 1.0),
    }.items():
        for function in (jd.deform_batch, jd.deform_in_chunks):
            with pytest.raises(jd.InputError, match=message):
                function(problem, *arguments)
    with pytest.raises(jd.InputError, match=r"rigidity: traced by JAX"):
        jax.jit(lambda r: jd.deform_batch(problem, targets, r).vertices)(rigidity)


@pytest.mark.slow
@pytest.mark.parametrize("cpus", ["all", pytest.param("one", marks=ONE_CPU)])
def test_eight_devices(alone, tmp_path, cpus):
    """More devices than CPUs: no hang, and the same shapes."""
    before = one_cpu() if cpus == "one" else ()
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=8"
    subprocess.run(
        [*before, sys.executable, CHILD, tmp_path / "8.npz"],
        env=os.environ | {"XLA_FLAGS": flags},
        check=True,
        timeout=600,
    )
    check(tmp_path / "8.npz", alone, 8)


@pytest.mark.slow
def test_two_processes(alone, tmp_path):
    """Both get the whole batch, of which each computed a half."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = str(free.getsockname()[1])
    files = [tmp_path / f"{k}.npz" for k in range(2)]
    ran = [
        subprocess.Popen([sys.executable, CHILD, file, port, str(k)])
        for k, file in enumerate(files)
    ]
    try:
        assert [process.wait(timeout=600) for process in ran] == [0, 0]
    finally:
        for process in ran:
            process.kill()
    for file in files:
        check(file, alone, 2)


def check(file: Path, alone: list[jd.Solution], devices: int) -> None:
    with np.load(file) as found:
        assert found["devices"] == devices
        assert "Not solved" in str(found["raised"])
        for k, one in enumerate(alone):
            np.testing.assert_allclose(found["vertices"][k], one.vertices, atol=1e-10)
            np.testing.assert_allclose(found["energy"][k], one.energy[-1], rtol=1e-10, atol=1e-10)
