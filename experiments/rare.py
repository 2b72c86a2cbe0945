"""How rarely does an agent crash, and from where does it crash most? (`rp_jax.rare`)

Multilevel splitting against plain episodes of as many steps; then a search for the worst starts.

python -m experiments.rare --run results/RUN --variant N=8 --out results/rare
python -m experiments.rare --run results/NEW --variant N=8 --out results/again \\
    --starts results/rare/worst_starts   # another agent, from the worst starts of that one
"""

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from experiments import cli, console, runs, tasks
from rp_jax import evaluate, rare, statistics, storage
from rp_jax.envs.base import select
from rp_jax.planning.pmdp import PMDP
from rp_jax.validate import number, one_of

STARTS = "start states"  # what the worst starts are saved as
MOST_STARTS = 100_000


@dataclass(frozen=True, kw_only=True)
class Config(runs.Choice):
    """What is measured."""

    out: Path  # new folder for the results
    particles: int = 1000  # paths a stage
    repeats: int = 20  # independent estimates, for the interval
    generations: int = 10  # of the search for the worst starts; 0: no search
    population: int = 200  # starts a generation
    tries: int = 50  # episodes from each start
    kept: int = 20  # worst starts that are kept
    checks: int = 2000  # fresh episodes from each of those
    starts: Path | None = None  # worst starts found before: these alone are played

    def validate(self) -> None:
        """Raises ValueError, naming the field, if a value is out of range."""
        super().validate()
        number("particles", self.particles, least=10, integer=True)
        number("repeats", self.repeats, least=2, integer=True)
        number("generations", self.generations, least=0, integer=True)
        number("population", self.population, least=10, integer=True)
        number("tries", self.tries, least=1, integer=True)
        number("kept", self.kept, least=1, most=min(self.population, MOST_STARTS), integer=True)
        number("checks", self.checks, least=1, integer=True)


class Subject(NamedTuple):
    """The agent under test."""

    pmdp: PMDP
    values: rare.Values
    stage: Any  # `rare.advance`, compiled


def estimates(key: jax.Array, subject: Subject, config: Config) -> tuple[dict[str, Any], Any]:
    """Crash probability by splitting and by plain episodes; and starts that led to crashes."""
    pilot, key, plain_key = jax.random.split(key, 3)
    pmdp, values, stage = subject
    began = time.perf_counter()
    levels, steps = rare.choose_levels(pilot, pmdp, config.particles, stage)
    found = []
    with console.progress("splitting") as bar:
        for i in range(config.repeats):
            bar("", i, config.repeats, f"{len(levels)} levels")
            this = jax.random.fold_in(key, i)
            found.append(rare.splitting(this, pmdp, values, levels, config.particles, stage=stage))
        bar("", config.repeats, config.repeats)
    steps += sum(run.steps for run in found)
    mean, width = statistics.mean_interval(np.asarray([run.estimate for run in found]))
    took = time.perf_counter() - began
    n = k = played = 0
    with console.progress("plain episodes") as bar:
        while played < steps:
            start, play = jax.random.split(jax.random.fold_in(plain_key, n))
            paths = stage(play, rare.begin(start, pmdp, config.particles), pmdp, np.inf)
            n, k = n + config.particles, k + int(paths.crashed.sum())
            played += int(paths.length.sum())
            bar("", min(played, steps), steps, f"{k} crashes of {n:,}")
    low, high = statistics.clopper_pearson(k, n)
    row = {
        "levels": levels,
        "rates": np.mean([r.rates for r in found if len(r.rates) == len(levels) + 1], axis=0)
        if any(len(r.rates) == len(levels) + 1 for r in found)
        else [],
        "estimate": mean,
        # Of repeats without a crash, the spread says nothing.
        "ci95": [max(0.0, mean - width), mean + width] if mean > 0 else None,
        "repeats": config.repeats,
        "steps": steps,
        "seconds": took,
        "plain": {"episodes": n, "crashes": k, "rate": k / n, "ci95": [low, high], "steps": played},
    }
    starts = [run.starts for run in found if run.starts is not None]
    together = jax.tree.map(lambda *a: np.concatenate(a), *starts) if starts else None
    return row, together


def crashes_from(key: jax.Array, subject: Subject, starts: Any, tries: int) -> np.ndarray:
    """(n,) crashes in `tries` episodes from each of the starts (n, ...)."""
    count = starts.time.shape[0]
    block = max(1, min(tries, 20_000 // count))
    total = np.zeros(count, int)
    many = jax.tree.map(lambda a: jnp.repeat(jnp.asarray(a), block, axis=0), starts)
    for i, done in enumerate(range(0, tries, block)):
        paths = rare.from_starts(many, subject.pmdp)
        this = jax.random.fold_in(key, i)
        crashed = subject.stage(this, paths, subject.pmdp, np.inf).crashed
        total += np.asarray(crashed).reshape(count, block)[:, : tries - done].sum(axis=1)
    return total


def offspring(key: jax.Array, parent: Any, fresh: Any, share: float = 0.2) -> Any:
    """A start like its parent, in which obstacles are drawn afresh with probability `share`.

    Obstacles are independent of one another at the start, so it is one that the environment may
    draw. Without obstacles, the whole start is drawn afresh with that probability.
    """
    if not hasattr(parent, "obstacles"):
        return select(jax.random.bernoulli(key, share), fresh, parent)
    renewed = jax.random.bernoulli(key, share, parent.present.shape)
    rows = jax.vmap(select)(
        renewed, (fresh.obstacles, fresh.present), (parent.obstacles, parent.present)
    )
    return parent.replace(obstacles=rows[0], present=rows[1])


def distinct(starts: Any) -> Any:
    """(m, ...) each of the starts (n, ...) once, in the order of their first appearance."""
    rows = [np.asarray(a) for a in jax.tree.leaves(starts)]
    flat = [np.ascontiguousarray(a.reshape(len(a), -1)).view(np.uint8) for a in rows]
    _, first = np.unique(np.concatenate(flat, axis=1), axis=0, return_index=True)
    kept = np.sort(first)
    return jax.tree.map(lambda a: a[kept], starts)


def worst_starts(key: jax.Array, subject: Subject, first: Any, config: Config) -> Any:
    """The starts (kept, ...) of most crashes: the worst tenth of each generation has offspring.

    Args:
        key: of the search.
        subject: the agent.
        first: starts that have led to crashes, (n, ...), copies included; or None. Half of the
            first generation is of them.
        config: sizes.

    Returns:
        At most `kept` different starts.
    """
    pmdp, size = subject.pmdp, config.population
    elite = max(config.kept, size // 10)
    draw = jax.jit(
        lambda key: jax.vmap(pmdp.env.reset, (0, None))(jax.random.split(key, size), pmdp.params)
    )
    breed = jax.jit(jax.vmap(offspring))
    first_key, mix, key = jax.random.split(key, 3)
    starts = draw(first_key)
    if first is not None:
        known = distinct(first)
        picked = np.asarray(jax.random.permutation(mix, known.time.shape[0])[: size // 2])
        rest = size - len(picked)
        starts = jax.tree.map(lambda a, b: jnp.concatenate([a[picked], b[:rest]]), known, starts)
    with console.progress("worst starts") as bar:
        for i in range(config.generations):
            play, parent_key, fresh_key, mix_key = jax.random.split(jax.random.fold_in(key, i), 4)
            starts = distinct(starts)
            crashes = crashes_from(play, subject, starts, config.tries)
            order = np.argsort(-crashes, kind="stable")[:elite]
            note = f"the worst {elite} crash in {100 * crashes[order].mean() / config.tries:.1f} %"
            bar("", i + 1, config.generations, note)
            best = jax.tree.map(lambda a, order=order: a[order], starts)
            fresh = draw(fresh_key)
            chosen = jax.random.randint(parent_key, (size,), 0, len(order))
            parents = jax.tree.map(lambda a, chosen=chosen: a[chosen], best)
            children = breed(jax.random.split(mix_key, size), parents, fresh)
            more = size - len(order)
            children = jax.tree.map(lambda a, more=more: a[:more], children)
            starts = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), best, children)
    return jax.tree.map(lambda a: a[: config.kept], best)


def known_starts(folder: Path, pmdp: PMDP, about: dict[str, Any]) -> Any:
    """Starts (n, ...) that an earlier search has kept.

    Raises:
        ValueError: they are missing, damaged, or of another task or test.
    """
    found = storage.read_manifest(folder, STARTS)["about"]
    for field in ("env", "variant"):
        one_of(f"{folder}: {field}", str(found.get(field)), [about[field]])
    number(f"{folder}: count", found.get("count"), least=1, most=MOST_STARTS, integer=True)
    one = jax.eval_shape(pmdp.env.reset, jax.random.key(0), pmdp.params)
    like = jax.tree.map(lambda a: jax.ShapeDtypeStruct((found["count"], *a.shape), a.dtype), one)
    return storage.load(folder, STARTS, like)


def chosen(config: Config, loaded: runs.Run) -> tuple[runs.Subject, dict[str, Any], Any]:
    """The agent, what results say of it, and the starts that were found before, or None.

    Raises:
        ValueError: there is no such test, agent or set of starts.
    """
    subject = loaded.subject(config.variant, config.agent)
    about = {"env": loaded.task.name, "variant": subject.variant, "sha256": loaded.sha256}
    known = None if config.starts is None else known_starts(config.starts, subject.pmdp, about)
    return subject, about, known


def run(config: Config, loaded: runs.Run, folder: Path) -> dict[str, Any]:
    """Writes rare.json and, after a search, the folder worst_starts."""
    (_, pmdp, network, weights), about, known = chosen(config, loaded)
    row: dict[str, Any] = {**about, "seed": config.seed}
    values = evaluate.action_values(network, weights)
    subject = Subject(pmdp, values, rare.compiled(values))
    key, search, check = jax.random.split(tasks.key_of(config.seed, tasks.RARE), 3)
    if known is None:
        found, first = estimates(key, subject, config)
        row |= found
        storage.write_json(folder / "rare.json", row)  # the search may take long
        show(row)
        if config.generations > 0:
            known = worst_starts(search, subject, first, config)
            count = known.time.shape[0]
            storage.save(folder / "worst_starts", STARTS, known, {**about, "count": count})
    if known is not None:
        crashes = crashes_from(check, subject, known, config.checks)
        row["worst_starts"] = [
            {
                "crashes": int(k),
                "episodes": config.checks,
                "ci95": list(statistics.clopper_pearson(int(k), config.checks)),
            }
            for k in crashes
        ]
        storage.write_json(folder / "rare.json", row)
        show_worst(row["worst_starts"])
    return row


def show(row: dict[str, Any]) -> None:
    """The estimates on the terminal."""
    plain = row["plain"]
    lines = [
        {
            "by": f"splitting, {len(row['levels'])} levels, {row['repeats']} repeats",
            "crash rate": f"{row['estimate']:.3g}",
            "95 %": "[{:.3g}, {:.3g}]".format(*row["ci95"]) if row["ci95"] else "-",
            "steps": f"{row['steps']:,}",
        },
        {
            "by": f"plain, {plain['crashes']} of {plain['episodes']:,} episodes",
            "crash rate": f"{plain['rate']:.3g}",
            "95 %": "[{:.3g}, {:.3g}]".format(*plain["ci95"]),
            "steps": f"{plain['steps']:,}",
        },
    ]
    console.table(f"crash rate of {row['env']} {row['variant']}", lines, list(lines[0]))


def show_worst(rows: list[dict[str, Any]]) -> None:
    """The starts that were found, in a line."""
    k, n = sum(r["crashes"] for r in rows), sum(r["episodes"] for r in rows)
    low, high = statistics.clopper_pearson(k, n)
    console.say(
        f"from the {len(rows)} worst starts found: {k} crashes of {n:,}, "
        f"{100 * k / n:.2f} [{100 * low:.2f}, {100 * high:.2f}] %"
    )


def main() -> None:
    """Exits with 2 on bad input."""
    config = tyro.cli(Config, description=__doc__)
    with cli.bad_input():
        config.validate()
        loaded = runs.load(config.run)
        chosen(config, loaded)
        folder = storage.new_folder(config.out)
        storage.write_json(folder / "config.json", dataclasses.asdict(config))
        run(config, loaded, folder)


if __name__ == "__main__":
    main()
