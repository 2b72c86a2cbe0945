"""How time grows with environments, obstacles, seeds and replay: log-log plots with slopes."""

import argparse
import dataclasses
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import env_step, seeds, train_step
from benchmarks.bound import Piece
from benchmarks.measure import Row, measure
from benchmarks.report import machine
from benchmarks.setups import more_chunks, pmdp_of, quick_tasks
from rp_jax import storage
from rp_jax.cli import terminal
from rp_jax.envs import jam

ENVS = tuple(4**k for k in range(8))  # 1 .. 16,384
OBSTACLES = (8, 16, 32, 64, 128, 256, 512)
SEEDS = (1, 2, 4, 8, 16)
REPLAYS = (2**14, 2**16, 2**18, 2**20)  # transitions
BATCH = 256  # environments, where obstacles grow


@dataclass(frozen=True)
class Series:
    """Times over one size."""

    title: str
    size: str  # what grows
    vertical: str  # what takes the seconds
    sizes: list[int]
    seconds: list[float]  # median
    fastest: list[float]
    slowest: list[float]
    slope: float  # of log seconds over log size, among the `fitted` largest sizes
    fitted: int


def series(
    title: str, size: str, vertical: str, sizes: Sequence[int], rows: Sequence[Row], units: float
) -> Series:
    """Returns the series of one row per size, ascending.

    The slope is a least-squares fit over the larger half of the sizes: small ones pay for dispatch.

    Args:
        title: of the plot.
        size: what grows.
        vertical: what takes the seconds.
        sizes: at least two.
        rows: one per size.
        units: that make one of `vertical`, per row of the batch.
    """
    counts = [units * row.batch for row in rows]

    def seconds(rate: str) -> list[float]:
        return [n / getattr(row, rate) for n, row in zip(counts, rows, strict=True)]

    middle, fitted = seconds("per_second"), max(2, -(-len(sizes) // 2))
    slope = np.polyfit(np.log(sizes[-fitted:]), np.log(middle[-fitted:]), 1)[0]
    return Series(
        title=title,
        size=size,
        vertical=vertical,
        sizes=list(sizes),
        seconds=middle,
        fastest=seconds("fastest"),
        slowest=seconds("slowest"),
        slope=float(slope),
        fitted=fitted,
    )


def envs(sizes: Sequence[int] = ENVS) -> Series:
    """A step of all environments of Jam, with observations."""
    rows = [env_step.row("jam", jam, jam.make_params(), True, size) for size in sizes]
    return series("Jam N=8, observed", "environments", "step of all", sizes, rows, 1)


def room_for(count: int) -> jam.Params:
    """Returns Jam among so many obstacles, in a room in which they stand as densely as 8 in 3 x 3.

    Args:
        count: number of obstacles.
    """
    return jam.make_params(count, room=jam.ROOM * math.sqrt(count / 8))


def obstacles(sizes: Sequence[int] = OBSTACLES) -> Series:
    """A step of a batch of Jam, with observations."""
    rows = [env_step.row("jam", jam, room_for(n), True, BATCH) for n in sizes]
    title = f"Jam at equal density, observed, {BATCH} environments"
    return series(title, "obstacles", "step of all", sizes, rows, 1)


def threats(sizes: Sequence[int] = OBSTACLES) -> Series:
    """Threats and observations of a batch of Jam, the vehicle in the middle of the room."""
    world, config = quick_tasks()["jam"]
    pmdp, rows = pmdp_of(world, config), []
    for size in sizes:
        now = pmdp.replace(params=room_for(size))
        states = jax.jit(jax.vmap(jam.reset, (0, None)))(
            jax.random.split(jax.random.key(0), BATCH), now.params
        )
        middle = jnp.broadcast_to(now.params.room / 2, (BATCH, 2))
        states = states.replace(body=states.body.replace(position=middle))
        program = lambda pmdp, states: pmdp.perceive(states)  # noqa: E731
        pieces = [Piece(program, (now, states)), *more_chunks(now, states)]
        rows.append(
            measure("jam", "states", BATCH, BATCH, program, now, states, repeats=20, pieces=pieces)
        )
    title = f"Jam at equal density, {BATCH} states"
    return series(title, "obstacles", "look and threats of all", sizes, rows, 1)


def side_by_side(sizes: Sequence[int] = SEEDS) -> Series:
    """A step of all environments of all runs, learning included."""
    _, config = seeds.quick_tasks()["jam"]
    units = config.planning.num_envs
    rows = seeds.run(tuple(sizes))
    return series("training loop, Jam", "seeds", "iteration of all", sizes, rows, units)


def replay(sizes: Sequence[int] = REPLAYS) -> Series:
    """A step of all environments, learning included."""
    world, config = quick_tasks()["jam"]
    pmdp, rows = pmdp_of(world, config), []
    for size in sizes:
        planning = dataclasses.replace(config.planning, replay=size)
        rows.append(train_step.row("jam", pmdp, planning))
    return series("training loop, Jam", "replay, transitions", "iteration", sizes, rows, 1)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.growth")
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"), help="folder")
    out = parser.parse_args().out
    from rp_jax.plot.growth import growth  # after the arguments: --help needs no matplotlib

    found = [asdict(grow()) for grow in (envs, obstacles, threats, side_by_side, replay)]
    lines = [{name: one[name] for name in ("title", "size", "vertical", "slope")} for one in found]
    terminal.table("growth", lines, list(lines[0]))
    out.mkdir(parents=True, exist_ok=True)
    storage.write_json(out / "growth.json", {"machine": machine(), "series": found})
    growth(found, out / "growth.png")


if __name__ == "__main__":
    main()
