"""A batch over the devices that JAX sees in this process (several GPUs), by `jax.sharding`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

BATCH = "batch"


def over_devices(run, model, rows, **options):
    """`run(model, *rows, **options)` for a function that treats each row of the batch by itself: a dict of (rows, ...) arrays.

    With several devices each takes an equal share of the rows (the batch is filled up with its last row where it does not
    divide). Every device runs its own loops until its own rows have settled: a plain sharded `jit` would let all wait for
    each other at every step of every loop. `options`: not traced.
    """
    rows = [np.asarray(x) for x in rows]
    devices = jax.local_devices()
    if len(devices) == 1:
        return run(model, *(jnp.asarray(x) for x in rows), **options)
    count = len(rows[0])
    surplus = -count % len(devices)
    # a Mesh made directly: `jax.make_mesh` has changed its axis types between the releases that are admitted
    mesh = jax.sharding.Mesh(np.asarray(devices), (BATCH,))
    placement = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec(BATCH))
    placed = [jax.device_put(np.append(x, np.repeat(x[-1:], surplus, axis=0), axis=0), placement) for x in rows]
    found = _run_sharded(run, model, placed, mesh, tuple(options.items()))
    return {name: value[:count] for name, value in found.items()}


@eqx.filter_jit
def _run_sharded(run, model, rows, mesh, options):
    numbers, rest = eqx.partition(model, eqx.is_array)
    split, whole = jax.sharding.PartitionSpec(BATCH), jax.sharding.PartitionSpec()

    def own_share(values, *own):
        return run(eqx.combine(values, rest), *own, **dict(options))

    return jax.shard_map(own_share, mesh=mesh, in_specs=(whole, *(split for _ in rows)), out_specs=split, check_vma=False)(
        numbers, *rows
    )
