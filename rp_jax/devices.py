"""Rows side by side on all devices, of one process or of many: seeds, rollouts, episodes.

Every process runs the same program on the same input; what comes back is the same for all.
"""

import os
from collections.abc import Callable
from typing import Any

import jax
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

DEVICES = ("one", "all", "cluster")
ROWS = "rows"  # the only axis of a mesh


def connect(devices: str) -> None:
    """Joins the other processes of a cluster; call it before anything else asks for a device.

    Slurm, Open MPI, Kubernetes and Cloud TPU tell JAX who they are. Elsewhere each process is told
    by JAX_COORDINATOR_ADDRESS (HOST:PORT of process 0), JAX_NUM_PROCESSES and JAX_PROCESS_ID.

    Args:
        devices: one of `DEVICES`; does nothing unless "cluster".

    Raises:
        ValueError: no cluster is found, or it does not answer.
    """
    if devices != "cluster" or jax.distributed.is_initialized():
        return
    count, number = (os.environ.get(name) for name in ("JAX_NUM_PROCESSES", "JAX_PROCESS_ID"))
    try:
        jax.distributed.initialize(
            num_processes=int(count) if count else None,
            process_id=int(number) if number else None,
        )
    except (RuntimeError, ValueError) as error:
        raise ValueError(
            f"devices is 'cluster'; it must be started by a cluster's launcher, or with "
            f"JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES and JAX_PROCESS_ID set ({error})"
        ) from error


def mesh_of(devices: str) -> Mesh | None:
    """All devices of all connected processes in a line; None for one device."""
    if devices == "one":
        return None
    return jax.make_mesh((jax.device_count(),), (ROWS,), axis_types=(AxisType.Auto,))


def divides(field: str, rows: int, mesh: Mesh | None) -> None:
    """Raises ValueError, naming the field, if rows cannot be shared out evenly."""
    if mesh is not None and rows % mesh.size:
        raise ValueError(
            f"{field} is {rows}; with {mesh.size} devices it must be a multiple of {mesh.size}"
        )


def _specs(in_axes: Any) -> Any:
    """Partitions for the arguments of a vmap."""
    spec = lambda axis: P() if axis is None else P(ROWS)  # noqa: E731
    return jax.tree.map(spec, in_axes, is_leaf=lambda axis: axis is None)


def spread(function: Callable, in_axes: Any, mesh: Mesh | None) -> Callable:
    """`jax.vmap(function, in_axes)` whose rows are shared out over the devices of the mesh.

    Each device runs the vmapped program on its own rows, without a word to the others.

    Args:
        function: of arrays, with results that are arrays.
        in_axes: as of `jax.vmap`, a tuple; axes must be 0 or None.
        mesh: None leaves everything on one device.
    """
    mapped = jax.vmap(function, in_axes)
    return mapped if mesh is None else share_out(mapped, in_axes, mesh)


def share_out(function: Callable, in_axes: Any, mesh: Mesh) -> Callable:
    """A function of whole batches, of which each device gets its own part; see `spread`."""
    specs = _specs(in_axes)
    return jax.shard_map(function, mesh=mesh, in_specs=specs, out_specs=P(ROWS), check_vma=False)


def place(arguments: tuple, in_axes: Any, mesh: Mesh | None) -> tuple:
    """The arguments of a `spread` function where it wants them."""
    if mesh is None:
        return arguments
    shardings = jax.tree.map(lambda spec: NamedSharding(mesh, spec), _specs(in_axes))
    return jax.jit(_same, out_shardings=shardings)(*arguments)


def _same(*arguments: Any) -> tuple:
    """By name, so that it is compiled once for all calls alike."""
    return arguments


def placed(shapes: Any, mesh: Mesh | None) -> Any:
    """The shapes of rows, as they come out of a `spread` function."""
    if mesh is None:
        return shapes
    sharding = NamedSharding(mesh, P(ROWS))
    put = lambda s: jax.ShapeDtypeStruct(s.shape, s.dtype, sharding=sharding)  # noqa: E731
    return jax.tree.map(put, shapes)


def returned(rows: Any, mesh: Mesh | None) -> Any:
    """Rows that were read from a file where a `spread` function leaves them; others as they are."""
    return rows if mesh is None else jax.device_put(rows, NamedSharding(mesh, P(ROWS)))


def gather(rows: Any, mesh: Mesh | None) -> Any:
    """All rows in the memory of every process."""
    if mesh is None:
        return rows
    if one_process():
        return jax.device_get(rows)
    return multihost_utils.process_allgather(rows, tiled=True)


def agreed(tree: Any) -> Any:
    """The first process's values, on every process: machines may differ in the last bits."""
    return tree if one_process() else multihost_utils.broadcast_one_to_all(tree)


def one_process() -> bool:
    """Whether there are no others, so that all rows are within reach."""
    return jax.process_count() == 1


def is_first() -> bool:
    """Whether this is the process that writes the results."""
    return jax.process_index() == 0
