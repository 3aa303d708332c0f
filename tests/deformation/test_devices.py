"""Members of a batch on several devices, by JAX's own means: ``shard_map``, and ``vmap``."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers import ONE_CPU, one_cpu

CHILD = Path(__file__).with_name("devices_child.py")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cpus", "names"),
    [
        ("all", ["targets", "rigidity", "steps", "gradient", "path", "sr_arap", "callback"]),
        pytest.param("one", ["targets"], marks=ONE_CPU),
    ],
)
def test_members_stay_on_their_devices(tmp_path, cpus, names):
    """Eight devices, more than CPUs: no hang, nothing gathered, and the shapes of a loop."""
    before = one_cpu() if cpus == "one" else ()
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=8"
    subprocess.run(
        [*before, sys.executable, CHILD, tmp_path / "8.npz", *names],
        env=os.environ | {"XLA_FLAGS": flags},
        check=True,
        timeout=900,
    )
    found = np.load(tmp_path / "8.npz")
    assert found["devices"] == 8
    ways = [name for name in found.files if name.endswith(("/shard_map", "/vmap"))]
    assert len(ways) == 2 * len(names) + 1
    for name in ways:
        alone = found[f"{name.split('/')[0]}/alone"]
        scale = np.abs(alone).max()
        np.testing.assert_allclose(found[name], alone, rtol=0, atol=1e-8 * scale, err_msg=name)
    assert {name for name in found.files if name.endswith("/kept") and not found[name]} == set()
