"""The shield around policies that know nothing of threat: Jam as a brax environment.

python -m experiments.shielded --out results/shielded
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from experiments import cli, console, jam, pipeline, recipes, reconnaissance, tables, tasks
from experiments.evaluation import ROUND
from rp_jax import evaluate, storage
from rp_jax.adapters import brax
from rp_jax.envs.base import Env, select
from rp_jax.planning.pmdp import PMDP, not_finite
from rp_jax.threat.build import ThreatConfig
from rp_jax.validate import number

EPISODES = 100  # stream of random numbers, apart from the pipeline's


@dataclass(frozen=True)
class Config:
    """Settings of the comparison."""

    out: Path | None = None  # folder for results; default: results/shielded-jam-TIME
    threat: Path | None = None  # folder of a threat function to use again
    x: float = 0.01  # largest admissible threat
    baseline: str = "paper"  # "paper" or "plans", as in experiments.jam
    obstacles: int = 8
    seed: int = 0
    episodes: int = 10_000  # per policy, with the shield and without
    steps: int = 300_000  # that brax's PPO learns for
    wall: ThreatConfig = field(default_factory=lambda: recipes.TUNED_WALL)  # threat of a wall point
    obstacle: ThreatConfig = field(default_factory=lambda: recipes.TUNED_OBSTACLE)  # of an obstacle

    def for_pipeline(self) -> jam.Config:
        """The same, as experiments.jam has it."""
        given = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        del given["steps"]
        return jam.Config(**given)


class Policy(NamedTuple):
    """Anything that acts on observations."""

    act: Callable[[Any, jax.Array, jax.Array], jax.Array]  # (weights, observations, key) -> actions
    weights: Any
    table: jax.Array | None  # (A, 2) what stands for its actions, if they are continuous


def uniform(count: int) -> Policy:
    """Scores at random: all actions alike, and under a shield all that are admissible."""
    return Policy(lambda _, obs, key: jax.random.uniform(key, (len(obs), count)), None, None)


def learned(env: Env, params: Any, config: Config) -> Policy:
    """What brax's PPO learns from the reward alone."""
    from brax.training.agents.ppo import train as ppo

    adapted = brax.BraxEnv(env, params)
    with console.progress("PPO of brax") as bar:

        def tell(done: int, metrics: dict[str, Any]) -> None:
            note = f"return {metrics['eval/episode_reward']:.1f}"
            bar("", min(done, config.steps), config.steps, note)

        bar("", 0, config.steps, "compiling")
        make, weights, _ = ppo.train(
            environment=adapted,
            wrap_env_fn=brax.wrap,
            episode_length=adapted.time_limit,
            num_timesteps=config.steps,
            num_envs=256,
            unroll_length=16,
            batch_size=64,
            num_minibatches=4,
            num_updates_per_batch=4,
            learning_rate=3e-4,
            entropy_cost=1e-2,
            discounting=0.97,
            normalize_observations=True,
            num_evals=11,
            seed=config.seed,
            progress_fn=tell,
        )
    act = lambda weights, obs, key: make(weights, deterministic=True)(obs, key)[0]  # noqa: E731
    return Policy(act, weights, params.agent.shares)


def played(key: jax.Array, pmdp: PMDP, weights: Any, policy: Policy, discrete: bool) -> Any:
    """ROUND episodes of the shielded brax environment, or of the bare one if not `discrete`."""
    env = brax.training.VmapWrapper(brax.BraxEnv(pmdp.env, pmdp.params))
    if discrete:
        threat = lambda state: pmdp.threat(state.pipeline_state, state.done == 0)  # noqa: E731
        env = brax.Shielded(env, threat, pmdp.x, policy.table)
    start_key, act_key = jax.random.split(key)
    state = env.reset(jax.random.split(start_key, ROUND))
    rows = evaluate.blank(pmdp.env, state.pipeline_state, pmdp.params)
    never = jnp.zeros(ROUND)

    def advance(carry):
        t, alive, state, rows = carry
        action = policy.act(weights, state.obs, jax.random.fold_in(act_key, t))
        reached = env.step(state, action)
        hit = jax.vmap(pmdp.env.causes, (0, None))(reached.pipeline_state, pmdp.params)
        new = evaluate.Episodes(
            score=reached.reward,
            danger=reached.info["cost"],
            goal=reached.metrics["goal"] > 0,
            length=alive,
            interventions=reached.info.get("intervention", never) > 0,
            insecure=reached.info.get("insecure", never) > 0,
            causes=hit,
            bad_observations=not_finite(state.obs),
            bad_threats=never > 0,  # the shield's own
        )
        ended = (reached.done + reached.info["truncation"]) > 0
        kept = jax.vmap(select)(alive, reached, state)
        return t + 1, alive & ~ended, kept, evaluate.added(rows, new, alive)

    carry = (jnp.asarray(0), jnp.ones(ROUND, bool), state, rows)
    return jax.lax.while_loop(lambda c: jnp.any(c[1]), advance, carry)[3]


def compare(config: Config, task: tasks.Task, folder: Path) -> list[dict[str, Any]]:
    """One row per policy, without the shield and with it."""
    settings = config.for_pipeline()
    models, _, _ = reconnaissance.learn_threats(task, settings, folder)
    guarded = tasks.make_pmdp(task, settings, models, task.train)
    free = guarded.replace(threats=None, x=jnp.asarray(jnp.inf))
    random = uniform(task.env.num_actions(task.train))
    ppo = learned(task.env, task.train, config)
    shielded = f"x = {config.x:g}"
    cases = [  # the nearest row of the table stands for a continuous action
        ("random", "none", random, free, True),
        ("random", shielded, random, guarded, True),
        ("PPO", "none", ppo, free, False),
        ("PPO, nearest row", "none", ppo, free, True),
        ("PPO, nearest row", shielded, ppo, guarded, True),
    ]
    rounds = -(-config.episodes // ROUND)
    keys = jax.random.split(tasks.key_of(config.seed, EPISODES), rounds)
    rows: list[dict[str, Any]] = []
    with console.progress("episodes") as bar:
        for name, shown, policy, pmdp, discrete in cases:
            play = jax.jit(functools.partial(played, policy=policy, discrete=discrete))
            found: list[Any] = []
            for key in keys:
                bar("", len(rows) * rounds + len(found), len(cases) * rounds, f"{name}, {shown}")
                found.append(jax.tree.map(np.asarray, play(key, pmdp, policy.weights)))
            every = jax.tree.map(lambda *a: np.concatenate(a)[: config.episodes], *found)
            evaluate.check(every, name)
            found_of = evaluate.summarise(every, settings.penalty)
            rows.append({"policy": name, "shield": shown, **found_of})
        bar("", len(cases) * rounds, len(cases) * rounds)
    return rows


def show(rows: Sequence[dict[str, Any]]) -> None:
    """The table on the terminal."""
    shown = [
        {
            "policy": row["policy"],
            "shield": row["shield"],
            "crashes": f"{row['crashes']:,}",
            "% [95 %]": tables.percent(row),
            "return": tables.earned(row),
            "replaced %": f"{100 * row['interventions']:.1f}",
        }
        for row in rows
    ]
    title = f"Jam in brax, {rows[0]['episodes']:,} episodes each"
    console.table(title, shown, list(shown[0]))


def main(argv: Sequence[str] | None = None) -> Path:
    """The command line."""
    config = tyro.cli(Config, args=argv, description=__doc__)
    with cli.bad_input():
        number("steps", config.steps, least=1, most=10**9, integer=True)
        out = config.out or pipeline.default_out("shielded", "jam")
        settings = dataclasses.replace(config.for_pipeline(), out=out)
        task, folder = pipeline.prepare(jam.make_task, settings, "shielded")
    with cli.bad_input():
        rows = compare(config, task, folder)
    show(rows)
    storage.write_json(folder / "config.json", dataclasses.asdict(config))
    storage.write_json(folder / "table.json", rows)
    console.say(f"results: {folder}")
    return folder


if __name__ == "__main__":
    main()
