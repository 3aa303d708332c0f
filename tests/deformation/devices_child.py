"""What test_devices.py runs with several devices: ``devices_child.py FILE NAME...``.

Every function of a member by a loop, by ``shard_map`` as it stands, and by ``vmap`` of input that
is sharded. Writes the values, and whether the last left every member on its device.
"""

import re
import sys

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from batch_child import batch  # noqa: E402
from jax.sharding import AxisType, NamedSharding, PartitionSpec  # noqa: E402

import jaxdeform as jd  # noqa: E402
from jaxdeform._linalg.host_call import HostFunction  # noqa: E402

PART = PartitionSpec("batch")
# What XLA does to bring all members to every device.
GATHERED = re.compile(r"\b(all-gather|all-to-all|collective-permute)(-start)?\(")


def functions() -> dict[str, tuple]:
    """Return functions of one member, and their first argument for eight."""
    problem, targets, rigidity = batch()
    targets, rigidity = jnp.asarray(targets[:8]), jnp.asarray(rigidity[:8])
    paths = jnp.stack([targets, targets[::-1]], axis=1)
    handles, mesh = problem.handles, problem.mesh

    def shape(targets, rigidity=rigidity[4], **settings):
        return jd.deform(problem, targets, rigidity, **settings).vertices

    def height(rigidity):
        return jnp.mean(shape(targets[5], rigidity)[:, 2])

    double = HostFunction("unused", lambda out, x: np.multiply(x, 2.0, out=out), None)
    return {
        "callback": (lambda r: double(jax.ShapeDtypeStruct(r.shape, r.dtype), r), rigidity),
        "targets": (shape, targets),
        "rigidity": (lambda r: shape(targets[5], r), rigidity),
        "steps": (lambda t: shape(t, solver=jd.Alternating(steps=5)), targets),
        "gradient": (jax.grad(height), rigidity),
        "path": (lambda t: jd.deform_path(problem, t, rigidity[4]).vertices, paths),
        "sr_arap": (lambda t: jd.sr_arap(mesh, handles, t).vertices, targets),
    }


def shared_rigidity() -> tuple:
    """Return the gradient of a loss over all members to what they share, on devices and not."""
    problem, targets, rigidity = batch()
    targets = jnp.asarray(targets[:8])
    devices = jax.make_mesh((jax.device_count(),), ("batch",), axis_types=(AxisType.Auto,))

    def loss(rigidity, targets):
        one = lambda t: jnp.sum(jd.deform(problem, t, rigidity).vertices[:, 2])  # noqa: E731
        return jnp.sum(jax.vmap(one)(targets))

    def part_of_loss(rigidity, targets):
        return jax.lax.psum(loss(rigidity, targets), "batch")

    places = (PartitionSpec(), PART)
    apart = jax.shard_map(part_of_loss, mesh=devices, in_specs=places, out_specs=PartitionSpec())
    return tuple(jax.jit(jax.grad(f))(jnp.asarray(rigidity[4]), targets) for f in (loss, apart))


if __name__ == "__main__":
    devices = jax.make_mesh((jax.device_count(),), ("batch",), axis_types=(AxisType.Auto,))
    found = {}
    for name in sys.argv[2:]:
        function, members = functions()[name]
        alone = jax.jit(function)
        found[f"{name}/alone"] = jnp.stack([alone(one) for one in members])
        batched = jax.vmap(function)
        mapped = jax.jit(jax.shard_map(batched, mesh=devices, in_specs=PART, out_specs=PART))
        found[f"{name}/shard_map"] = mapped(members)
        members = jax.device_put(members, NamedSharding(devices, PART))
        program = jax.jit(batched).lower(members).compile()
        found[f"{name}/vmap"] = out = program(members)
        kept = out.sharding.is_equivalent_to(NamedSharding(devices, PART), out.ndim)
        found[f"{name}/kept"] = name == "callback" or (
            kept and not GATHERED.search(program.as_text())
        )
    found["shared/alone"], found["shared/shard_map"] = shared_rigidity()
    np.savez(sys.argv[1], devices=jax.device_count(), **found)
