"""Why does an agent crash? Each crash of many episodes, step by step, looked at closely.

In the last states before a crash, and for each action, many episodes go on from the same state: by
that action, and then as the agent does. So the risk of what it chose is seen beside that of the
best it could have chosen, and beside the threat that it chose by. The rest was bad luck.

python -m experiments.crashes --run docs/results/jam_ahead --variant N=8 --out results/crashes
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from experiments import cli, console, runs, tasks
from experiments.evaluation import ROUND
from rp_jax import evaluate, rare, statistics, storage
from rp_jax.planning.pmdp import PMDP
from rp_jax.validate import finite, number


@dataclass(frozen=True, kw_only=True)
class Config(runs.Choice):
    """What is looked at."""

    out: Path  # new folder for the results
    episodes: int = 20_000  # among which crashes are sought
    most: int = 30  # crashes looked at
    steps: int = 10  # before a crash, looked at
    tries: int = 64  # episodes for each state and action, of which the best action is chosen
    checks: int = 512  # fresh ones of that action, and of the agent's own
    figures: bool = True

    def validate(self) -> None:
        """Raises ValueError, naming the field, if a value is out of range."""
        super().validate()
        number("episodes", self.episodes, least=1, integer=True)
        number("most", self.most, least=1, integer=True)
        number("steps", self.steps, least=1, most=100, integer=True)
        number("tries", self.tries, least=1, integer=True)
        number("checks", self.checks, least=1, integer=True)


class Crash(NamedTuple):
    """The end of an episode, leading axis (steps,), oldest first; the crash comes after it."""

    states: Any
    action: np.ndarray
    threat: np.ndarray  # (steps, A)
    secure: np.ndarray
    hit: list[str]  # kinds of hazard
    length: int  # steps of the episode
    insecure: int  # steps in a row, up to the crash, in which no action was admissible


def found(
    key: jax.Array, pmdp: PMDP, values: rare.Values, config: Config
) -> tuple[list[Crash], int, int]:
    """(the first `most` crashes, all that were counted, episodes played)."""
    size = min(ROUND, config.episodes)
    limit = int(pmdp.params.time_limit)

    @jax.jit
    def play(key: jax.Array, pmdp: PMDP) -> tuple[evaluate.Recording, dict[str, jax.Array]]:
        start, go = jax.random.split(key)
        starts = jax.vmap(pmdp.env.reset, (0, None))(jax.random.split(start, size), pmdp.params)
        # One row more than steps: the state after the last one is seen too.
        shown = evaluate.record(go, pmdp, values, starts, limit + 1)
        causes = jax.vmap(jax.vmap(pmdp.env.causes, (0, None)), (0, None))
        return shown, causes(shown.states, pmdp.params)

    crashes: list[Crash] = []
    count, rounds = 0, -(-config.episodes // size)
    with console.progress("episodes") as bar:
        for i in range(rounds):
            bar("", i, rounds, f"{count} crashes of {i * size:,}")
            shown, causes = play(jax.random.fold_in(key, i), pmdp)
            finite("crashes: threats", shown.threat)
            met = np.any(list(causes.values()), axis=0)
            crashed = np.flatnonzero(met.any(axis=0))
            count += len(crashed)
            for episode in crashed[: config.most - len(crashes)]:
                at = int(met[:, episode].argmax())
                kinds = [kind for kind, hit in causes.items() if hit[at, episode]]
                crashes.append(ending(shown, int(episode), at, config.steps, kinds))
        bar("", rounds, rounds, f"{count} crashes of {rounds * size:,}")
    return crashes, count, rounds * size


def ending(shown: evaluate.Recording, episode: int, at: int, steps: int, kinds: list[str]) -> Crash:
    """The last `steps` steps of an episode that crashed in the state of row `at`."""
    part: Callable[[Any], np.ndarray] = lambda a: np.asarray(a[max(0, at - steps) : at, episode])  # noqa: E731
    secure = np.asarray(shown.secure[:at, episode])
    return Crash(
        states=jax.tree.map(part, shown.states),
        action=part(shown.action),
        threat=part(shown.threat),
        secure=part(shown.secure),
        hit=kinds,
        length=at,
        insecure=int(np.argmax(secure[::-1])) if secure.any() else at,
    )


def looked_at(
    key: jax.Array, crash: Crash, explore: Callable[..., Any], config: Config
) -> list[dict[str, Any]]:
    """A row per step before a crash, oldest first.

    Args:
        key: of the episodes that go on from there.
        crash: what happened.
        explore: (key, state, action) -> (best action, what it seems to save, its risk, that of
            `action`).
        config: sizes.
    """
    rows, n = [], config.checks
    for t, action in enumerate(crash.action):
        state = jax.tree.map(lambda a, t=t: a[t], crash.states)
        best, saves, of_best, of_own = explore(jax.random.fold_in(key, t), state, action)
        rows.append(
            {
                "before": len(crash.action) - t,
                "secure": bool(crash.secure[t]),
                "threat": float(crash.threat[t].min()),
                "action": int(action),
                "risk": float(of_own),
                "risk_ci95": list(statistics.clopper_pearson(round(float(of_own) * n), n)),
                "best_action": int(best),
                "seems_to_save": float(saves),
                "best_risk": float(of_best),
                "best_risk_ci95": list(statistics.clopper_pearson(round(float(of_best) * n), n)),
            }
        )
    return rows


def explorer(pmdp: PMDP, values: rare.Values, config: Config) -> Callable[..., Any]:
    """(key, state, action) -> (best action, what it seems to save, its risk, that of `action`).

    Compiled. The best action is chosen by some episodes and judged by others: the least of many
    estimates is too low.
    """
    actions = jnp.arange(pmdp.env.num_actions(pmdp.params))

    @jax.jit
    def explore(key: jax.Array, state: Any, action: jax.Array, pmdp: PMDP) -> Any:
        first, second = jax.random.split(key)
        one = jax.tree.map(lambda a: jnp.asarray(a)[None], state)
        tried = rare.risks(first, one, actions[None], pmdp, values, config.tries)[0]
        pair = jnp.stack([jnp.argmin(tried), action])
        risk = rare.risks(second, one, pair[None], pmdp, values, config.checks)[0]
        return pair[0], tried[action] - jnp.min(tried), risk[0], risk[1]

    return lambda key, state, action: explore(key, state, action, pmdp)


def summed_up(rows: list[dict[str, Any]], insecure: int) -> dict[str, Any]:
    """What a crash comes down to.

    `entered` is the risk of the last admissible action, before the steps in which there was none
    (None where that is further back than the steps looked at); `missed` what the best action would
    have taken off the risk, at the step at which that seemed most by the episodes that chose it:
    those that judge it have no say in the step, for the greatest of many estimates is too high.
    """
    last = [row for row in rows if row["before"] == insecure + 1 and row["secure"]]
    most = max(rows, key=lambda row: row["seems_to_save"])
    return {
        "entered": last[0]["risk"] if last else None,
        "missed_before": most["before"],
        "missed": most["risk"] - most["best_risk"],
    }


def run(config: Config, loaded: runs.Run, folder: Path) -> dict[str, Any]:
    """Writes crashes.json, kept up to date, and the figure."""
    variant, pmdp, network, weights = loaded.subject(config.variant, config.agent)
    values = evaluate.action_values(network, weights)
    find, look = jax.random.split(tasks.key_of(config.seed, tasks.CRASHES))
    crashes, count, episodes = found(find, pmdp, values, config)
    result: dict[str, Any] = {
        "env": loaded.task.name,
        "variant": variant,
        "sha256": loaded.sha256,
        "agent": config.agent,
        "seed": config.seed,
        "x": float(pmdp.x),
        "episodes": episodes,
        "crashes": count,
        "crash_ci95": list(statistics.clopper_pearson(count, episodes)),
        "tries": config.tries,
        "checks": config.checks,
        "looked_at": [],
    }
    explore = explorer(pmdp, values, config)
    with console.progress("crashes") as bar:
        for i, crash in enumerate(crashes):
            bar("", i, len(crashes), "looking closely")
            rows = looked_at(jax.random.fold_in(look, i), crash, explore, config)
            result["looked_at"].append(
                {
                    "hit": crash.hit,
                    "length": crash.length,
                    "insecure": crash.insecure,
                    **summed_up(rows, crash.insecure),
                    "steps": rows,
                }
            )
            storage.write_json(folder / "crashes.json", result)
        bar("", len(crashes), len(crashes))
    storage.write_json(folder / "crashes.json", result)
    show(result)
    if config.figures and crashes:
        from rp_jax.plot import curves

        curves.before_crashes([c["steps"] for c in result["looked_at"]], folder / "crashes.png")
    return result


def show(result: dict[str, Any]) -> None:
    """A line per crash on the terminal."""
    low, high = (100 * bound for bound in result["crash_ci95"])
    console.say(
        f"{result['crashes']} crashes of {result['episodes']:,} episodes, [{low:.3f}, {high:.3f}] %"
    )
    lines = [
        {
            "hit": ", ".join(crash["hit"]),
            "after": f"{crash['length']} steps",
            "none admissible": f"{crash['insecure']} steps",
            "risk before": "-" if crash["entered"] is None else f"{crash['entered']:.3f}",
            "best would have saved": f"{crash['missed']:.2f}, {crash['missed_before']} ahead",
        }
        for crash in result["looked_at"]
    ]
    if lines:
        console.table(f"{result['env']} {result['variant']}", lines, list(lines[0]))


def main() -> None:
    """Exits with 2 on bad input."""
    config = tyro.cli(Config, description=__doc__)
    with cli.bad_input():
        config.validate()
        cli.needs_matplotlib(config.figures, cli.NO_FIGURES)
        loaded = runs.load(config.run)
        loaded.subject(config.variant, config.agent)
        folder = storage.new_folder(config.out)
        storage.write_json(folder / "config.json", dataclasses.asdict(config))
        run(config, loaded, folder)


if __name__ == "__main__":
    main()
