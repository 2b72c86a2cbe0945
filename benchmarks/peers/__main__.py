"""Ours, the NumPy floor, and each peer that installs, one after another."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp

from benchmarks import env_step, train_step
from benchmarks.measure import Row
from benchmarks.peers import environments, numpy_jam
from benchmarks.report import machine, short
from benchmarks.setups import pmdp_of, quick_tasks
from rp_jax import storage
from rp_jax.cli import terminal
from rp_jax.envs import jam


class Peer(NamedTuple):
    """A learner that runs in an environment of its own."""

    requirements: tuple[str, ...]
    module: str


PEERS = {
    "stable-baselines3": Peer(("stable-baselines3",), "benchmarks.peers.sb3_dqn"),
    "rejax": Peer(("rejax",), "benchmarks.peers.rejax_dqn"),
}
ENVIRONMENT, LOOP = "rp_jax Jam, observed", "rp_jax DQN"  # what others are compared with


def ours() -> list[Row]:
    """Steps of Jam, and of the training loop without and with the shield."""
    world, config = quick_tasks()["jam"]
    shielded = pmdp_of(world, config)
    plain = shielded.replace(threats={}, shielded=False, x=jnp.asarray(jnp.inf))
    env = [
        replace(
            env_step.row("", jam, jam.make_params(), look, env_step.BATCH),
            name=ENVIRONMENT if look else "rp_jax Jam",
            unit="environment steps",
        )
        for look in (False, True)
    ]
    loops = [
        replace(train_step.row(name, pmdp, config.planning), unit="agent steps")
        for name, pmdp in ((LOOP, plain), ("rp_jax RP, shielded", shielded))
    ]
    return env + loops


def others(
    cache: Path, peers: Mapping[str, Peer], say: Callable[[str], None]
) -> tuple[list[Row], dict[str, str]]:
    """Rows of all peers that run, and why the others do not."""
    rows, skipped = [], {}
    for name, peer in peers.items():
        try:
            say(f"{name}: its environment is {cache / name}")
            python = environments.made(cache, name, peer.requirements)
            rows += environments.measured(python, peer.module)
        except environments.UnavailableError as error:
            skipped[name] = str(error)
            say(f"{name}: skipped, {error}")
    return rows, skipped


def compared(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """The rows as tables, each with how many times as fast ours is, in the same unit."""
    of = {row.unit: row.per_second for row in rows if row.name in (ENVIRONMENT, LOOP)}
    return [{**asdict(row), "ours_over_it": of[row.unit] / row.per_second} for row in rows]


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.peers")
    parser.add_argument("--cache", type=Path, default=Path("results/peers"), help="environments")
    parser.add_argument("--out", type=Path, help="folder for the JSON")
    given = parser.parse_args()
    rows, skipped = others(given.cache, PEERS, terminal.say)
    found = compared([*ours(), *numpy_jam.run(), *rows])
    shown = [
        {
            "what": row["name"],
            "unit": row["unit"],
            "batch": row["batch"],
            "per second": short(row["per_second"]),
            "spread": f"{short(row['slowest'])} .. {short(row['fastest'])}",
            "ours / it": short(row["ours_over_it"]),
        }
        for row in found
    ]
    terminal.table("peers", shown, list(shown[0]))
    if given.out is not None:
        given.out.mkdir(parents=True, exist_ok=True)
        value = {"machine": machine(), "rows": found, "skipped": skipped}
        storage.write_json(given.out / "peers.json", value)


if __name__ == "__main__":
    main()
