"""Compiled programs are kept for the next process, and never in the way of one."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import jaxdeform as jd

# Deform a small strip, and report how many programs came from the cache, and the result.
CHILD = """
import json, sys
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
import jaxdeform as jd
found = []
jax.monitoring.register_event_listener(
    lambda event, **_: found.append(event) if event.endswith("cache_hits") else None)
place = jd.enable_compilation_cache(sys.argv[1] or None)
mesh = jd.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.5], [0, 2, 0], [1, 2, 0]],
               [[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4]])
problem = jd.precompute(mesh, [0, 1, 4, 5])
targets = mesh.vertices[[0, 1, 4, 5]] + np.outer([0, 0, 1, 1], [0, 0, 1])
out = jd.deform(problem, targets, 0.1, solver=jd.Alternating(3))
print(json.dumps([str(place), len(found), np.asarray(out.vertices).tolist()]))
"""


def child(folder, **environment):
    own = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "JAXDEFORM_"))}
    ran = subprocess.run(
        [sys.executable, "-c", CHILD, str(folder)],
        env=own | environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert ran.returncode == 0, ran.stderr
    return *json.loads(ran.stdout), ran.stderr


@pytest.mark.slow
def test_the_next_process_finds_the_programs_and_damage_is_mended(tmp_path):
    """Truncated, empty, foreign: compiled anew, replaced, and the same result each time."""
    place, found, first, _ = child("", JAXDEFORM_CACHE_DIR=str(tmp_path / "new" / "folder"))
    assert Path(place).is_relative_to(tmp_path)
    entries = sorted(Path(place).glob("*-cache"))
    assert entries
    assert found == 0
    _, found, second, _ = child("", JAXDEFORM_CACHE_DIR=str(tmp_path / "new" / "folder"))
    assert found >= len(entries)
    assert second == first
    # The busier the machine, the more programs take long enough to be kept.
    for k, entry in enumerate(sorted(Path(place).glob("*-cache"))):
        content = entry.read_bytes()
        entry.write_bytes([content[: len(content) // 2], b"", b"no program"][k % 3])
    _, found, third, _ = child("", JAXDEFORM_CACHE_DIR=str(tmp_path / "new" / "folder"))
    assert found == 0
    assert third == first
    entries = sorted(Path(place).glob("*-cache"))
    assert entries
    _, found, fourth, _ = child("", JAXDEFORM_CACHE_DIR=str(tmp_path / "new" / "folder"))
    assert found >= len(entries)
    assert fourth == first


def test_the_oldest_go_when_the_folder_is_full(tmp_path, monkeypatch):
    from jaxdeform._apps import compilation_cache as cache

    monkeypatch.setattr(cache, "MOST_BYTES", 250)
    monkeypatch.setattr(cache, "_is_damaged", lambda path: False)
    for age, name in enumerate("abcd"):
        entry = tmp_path / f"{name}-cache"
        entry.write_bytes(bytes(100))
        os.utime(entry, (1e9 - age, 1e9 - age))
    (tmp_path / "mine.txt").write_bytes(bytes(1000))
    cache._clean(tmp_path)
    assert sorted(x.name for x in tmp_path.iterdir()) == [
        ".checked",
        "a-cache",
        "b-cache",
        "mine.txt",
    ]


def test_a_folder_that_cannot_be_used_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    for wrong in (tmp_path / "file", tmp_path / "file" / "below", 3, b"bytes", "nul\0"):
        with pytest.raises(jd.InputError, match="give another folder"):
            jd.enable_compilation_cache(wrong)
