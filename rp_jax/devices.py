"""Batches spread over all devices, of one process or of many: seeds, rollouts, episodes.

Every process runs the same program on the same input, and gets the same result back.
"""

import os
from collections.abc import Callable
from typing import Any

import jax
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

DEVICES = ("one", "all", "cluster")  # choices: one device, all of this machine, many machines
ROWS = "rows"  # name of the mesh's only axis


def connect(devices: str) -> None:
    """Joins the other processes of a cluster.

    To be called before anything else asks JAX for a device. Slurm, Open MPI, Kubernetes and Cloud
    TPU tell JAX about the cluster by themselves. Elsewhere each process has to be told by the
    environment variables JAX_COORDINATOR_ADDRESS (HOST:PORT of process 0), JAX_NUM_PROCESSES and
    JAX_PROCESS_ID.

    Args:
        devices: one of `DEVICES`; unless it is "cluster", nothing is done.

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
    """Returns a mesh of all devices of all connected processes in a line.

    Args:
        devices: one of `DEVICES`; "cluster" joins the other processes, unless they are joined.

    Returns:
        The mesh, with the single axis `ROWS`; None for "one".

    Raises:
        ValueError: no cluster is found, or it does not answer.
    """
    connect(devices)
    if devices == "one":
        return None
    return jax.make_mesh((jax.device_count(),), (ROWS,), axis_types=(AxisType.Auto,))


def divides(field: str, rows: int, mesh: Mesh | None) -> None:
    """Raises ValueError unless a number of rows can be divided evenly among the devices.

    Args:
        field: name of the number, for the message.
        rows: number of rows.
        mesh: the devices; None for one device, which any number suits.

    Raises:
        ValueError: the number is not a multiple of the number of devices.
    """
    if mesh is not None and rows % mesh.size:
        raise ValueError(
            f"{field} is {rows}; with {mesh.size} devices it must be a multiple of {mesh.size}"
        )


def _specs(in_axes: Any) -> Any:
    """Returns the partitions of arguments whose vmapped axes are `in_axes`."""
    spec = lambda axis: P() if axis is None else P(ROWS)  # noqa: E731
    return jax.tree.map(spec, in_axes, is_leaf=lambda axis: axis is None)


def sharded_vmap(function: Callable, in_axes: Any, mesh: Mesh | None) -> Callable:
    """Returns `jax.vmap(function, in_axes)` with its rows spread over the devices of a mesh.

    Each device runs the vmapped program on its own rows, without communication. The program of a
    single row is that of `function` itself, which compiles faster.

    Args:
        function: takes and returns pytrees of arrays.
        in_axes: as for `jax.vmap`; a tuple whose axes are 0 or None.
        mesh: the devices; None leaves everything on one device.
    """
    mapped = jax.vmap(function, in_axes)

    def rows(*arguments: Any) -> Any:
        none = lambda axis: axis is None  # noqa: E731
        found = jax.tree.map(
            lambda axis, part: None if axis is None else part, in_axes, arguments, is_leaf=none
        )
        if {len(leaf) for leaf in jax.tree.leaves(found)} != {1}:
            return mapped(*arguments)
        alone = jax.tree.map(
            lambda axis, part: part if axis is None else jax.tree.map(_only, part),
            in_axes,
            arguments,
            is_leaf=none,
        )
        return jax.tree.map(lambda leaf: leaf[None], function(*alone))

    return rows if mesh is None else shard_rows(rows, in_axes, mesh)


def _only(rows: Any) -> Any:
    """Returns the only row of an array."""
    return rows.reshape(rows.shape[1:])


def shard_rows(function: Callable, in_axes: Any, mesh: Mesh) -> Callable:
    """Returns a function of whole batches that gives each device a part of the rows.

    Args:
        function: takes and returns whole batches, pytrees of arrays with a leading axis.
        in_axes: 0 for each argument with rows, None for each that all devices get whole.
        mesh: the devices.
    """
    specs = _specs(in_axes)
    return jax.shard_map(function, mesh=mesh, in_specs=specs, out_specs=P(ROWS), check_vma=False)


def shard_arguments(arguments: tuple, in_axes: Any, mesh: Mesh | None) -> tuple:
    """Returns the arguments of a `sharded_vmap` function, moved to the devices that need them.

    Args:
        arguments: what the function will be called with.
        in_axes: as given to `sharded_vmap`.
        mesh: as given to `sharded_vmap`.
    """
    if mesh is None:
        return arguments
    shardings = jax.tree.map(lambda spec: NamedSharding(mesh, spec), _specs(in_axes))
    return jax.jit(_same, out_shardings=shardings)(*arguments)


def _same(*arguments: Any) -> tuple:
    """Returns its arguments; a named function, so that similar calls share one compilation."""
    return arguments


def sharded_shapes(shapes: Any, mesh: Mesh | None) -> Any:
    """Returns shapes of rows, with the devices on which a `sharded_vmap` function leaves them.

    Args:
        shapes: pytree of `jax.ShapeDtypeStruct`, each with a leading axis of rows.
        mesh: as given to `sharded_vmap`; None returns the shapes unchanged.
    """
    if mesh is None:
        return shapes
    sharding = NamedSharding(mesh, P(ROWS))
    put = lambda s: jax.ShapeDtypeStruct(s.shape, s.dtype, sharding=sharding)  # noqa: E731
    return jax.tree.map(put, shapes)


def shard(rows: Any, mesh: Mesh | None) -> Any:
    """Moves rows to the devices on which a `sharded_vmap` function would have left them.

    Args:
        rows: pytree of arrays with a leading axis, for example read from a file.
        mesh: as given to `sharded_vmap`; None returns the rows unchanged.
    """
    return rows if mesh is None else jax.device_put(rows, NamedSharding(mesh, P(ROWS)))


def gather(rows: Any, mesh: Mesh | None) -> Any:
    """Returns all rows in the memory of every process.

    Args:
        rows: result of a `sharded_vmap` function.
        mesh: as given to `sharded_vmap`; None returns the rows unchanged.
    """
    if mesh is None:
        return rows
    if one_process():
        return jax.device_get(rows)
    return multihost_utils.process_allgather(rows, tiled=True)


def broadcast_first(tree: Any) -> Any:
    """Returns the first process's values on every process.

    Machines may differ in the last bits of what they compute; after this call they do not.

    Args:
        tree: pytree of arrays, computed by every process.
    """
    return tree if one_process() else multihost_utils.broadcast_one_to_all(tree)


def one_process() -> bool:
    """Returns whether this is the only process, which then holds all rows."""
    return jax.process_count() == 1


def is_first() -> bool:
    """Returns whether this is the process that writes the results."""
    return jax.process_index() == 0
