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

from experiments import jam
from rp_jax import evaluation, recipes, storage
from rp_jax.adapters import brax
from rp_jax.cli import errors, terminal
from rp_jax.cli.experiment import Run, default_out, threats_of
from rp_jax.envs import optional
from rp_jax.envs.contract import Env, Outcome
from rp_jax.planning.percept import not_finite
from rp_jax.planning.pmdp import PMDP
from rp_jax.rollout import Step, rollout
from rp_jax.runs import tables, train
from rp_jax.runs.plan import make_pmdp
from rp_jax.runs.train import Process
from rp_jax.streams import Stream, key_of
from rp_jax.threat.build import ThreatConfig
from rp_jax.validate import number

ROUND = 1000  # episodes side by side


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

    def of_jam(self) -> jam.Config:
        """Returns the same settings, as experiments.jam has them."""
        own = {field.name for field in dataclasses.fields(jam.Config)}
        return jam.Config(**{name: value for name, value in vars(self).items() if name in own})


class Policy(NamedTuple):
    """Anything that acts on observations."""

    act: Callable[[Any, jax.Array, jax.Array], jax.Array]  # (weights, observations, key) -> actions
    weights: Any
    table: jax.Array | None  # (A, 2) what stands for its actions, if they are continuous


def uniform(count: int) -> Policy:
    """Returns scores at random: all actions alike, and under a shield all that are admissible."""
    return Policy(lambda _, obs, key: jax.random.uniform(key, (len(obs), count)), None, None)


def learned(env: Env, params: Any, config: Config) -> Policy:
    """Returns what brax's PPO learns from the reward alone."""
    from brax.training.agents.ppo import train as ppo

    adapted = brax.BraxEnv(env, params)
    with terminal.progress() as bar, brax.training_agents():

        def tell(done: int, metrics: dict[str, Any]) -> None:
            note = f"return {metrics['eval/episode_reward']:.1f}"
            bar("PPO of brax", min(done, config.steps), config.steps, note)

        bar("PPO of brax", 0, config.steps, "compiling")
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
    return Policy(act, weights, params.body.normalized_actions)


class BraxWorld(NamedTuple):
    """A batched brax environment, as `rollout` plays in it."""

    env: Any  # of brax

    def perceive(self, states: Any, alive: Any = None) -> Any:
        """Returns the observations of states (B,)."""
        return states.obs

    def advance(self, keys: Any, states: Any, actions: Any, percept: Any) -> tuple[Any, Outcome]:
        """Makes one transition of each state (B,), whose random keys are its own."""
        reached = self.env.step(states, actions)
        return reached, Outcome(
            reward=reached.reward,
            danger=reached.info["cost"],
            terminated=reached.done > 0,
            truncated=reached.info["truncation"] > 0,
            goal=reached.metrics["goal"] > 0,
        )


def played(
    key: jax.Array, pmdp: PMDP, weights: Any, policy: Policy, discrete: bool
) -> evaluation.Episodes:
    """Plays ROUND episodes of the shielded brax environment, or of the bare one.

    Args:
        key: of the episodes.
        pmdp: the environment, and what is admissible.
        weights: of the policy.
        policy: chooses the actions.
        discrete: whether actions are those of the table, as a shield needs them.
    """
    env, params = brax.training.VmapWrapper(brax.BraxEnv(pmdp.env, pmdp.params)), pmdp.params
    if discrete:
        threat = lambda state: pmdp.threat(state.pipeline_state, state.done == 0)  # noqa: E731
        env = brax.ShieldWrapper(env, threat, pmdp.x, policy.table)
    start_key, play_key = jax.random.split(key)
    starts = env.reset(jax.random.split(start_key, ROUND))
    no = jnp.zeros(ROUND, bool)

    def act(key: jax.Array, seen: jax.Array) -> tuple[jax.Array, jax.Array]:
        return policy.act(weights, seen, key), no

    def fold(rows: evaluation.Episodes, step: Step) -> evaluation.Episodes:
        told, states = step.reached.info, step.reached.pipeline_state
        hits = functools.partial(optional.collisions, pmdp.env)
        new = evaluation.Episodes(
            score=step.outcome.reward,
            danger=step.outcome.danger,
            goal=step.outcome.goal,
            length=step.moved,
            interventions=told.get("intervention", no) > 0,
            insecure=told.get("insecure", no) > 0,
            booked=no.astype(float),
            collisions=jax.vmap(hits, (0, None))(states, params),
            bad_observations=not_finite(step.percept),
            bad_threats=no,  # the shield's own
        )
        return evaluation.added(rows, new, step.moved)

    none = evaluation.no_episodes(pmdp.env, starts.pipeline_state, params)
    return rollout(play_key, BraxWorld(env), act, starts, fold, none)[1]


def prepared(config: Config) -> Run:
    """Returns the run whose threat function is used, checked, but for its folder.

    Raises:
        ValueError: a setting is out of range, or a file cannot be used.
    """
    number("steps", config.steps, least=1, most=10**9, integer=True)
    settings = config.of_jam()
    world = jam.make_world(settings)
    threats, process = threats_of(settings), Process(threat=config.threat, figures=False)
    train.checked(world, settings, threats, process)
    return Run(world, settings, threats, process, Path())


def compare(config: Config, run: Run) -> list[dict[str, Any]]:
    """Returns one row per policy, without the shield and with it."""
    env, params = run.world.env, run.world.params()
    with terminal.progress() as bar:
        threat = train.threat_of(
            jax.random.key(0), run.world, run.config, run.threats, run.folder, run.process, bar
        )
    guarded = make_pmdp(env, params, threat, x=config.x)
    free = make_pmdp(env, params, None, x=float("inf"))
    random = uniform(optional.num_actions(env, params))
    ppo = learned(env, params, config)
    shielded = f"x = {config.x:g}"
    cases = [  # the nearest row of the table stands for a continuous action
        ("random", "none", random, free, True),
        ("random", shielded, random, guarded, True),
        ("PPO", "none", ppo, free, False),
        ("PPO, nearest row", "none", ppo, free, True),
        ("PPO, nearest row", shielded, ppo, guarded, True),
    ]
    rounds = -(-config.episodes // ROUND)
    keys = jax.random.split(key_of(jax.random.key(config.seed), Stream.ADAPTERS), rounds)
    rows: list[dict[str, Any]] = []
    with terminal.progress() as bar:
        total = len(cases) * rounds
        for name, shown, policy, pmdp, discrete in cases:
            play = jax.jit(functools.partial(played, policy=policy, discrete=discrete))
            found: list[Any] = []
            for key in keys:
                bar("episodes", len(rows) * rounds + len(found), total, f"{name}, {shown}")
                found.append(jax.tree.map(np.asarray, play(key, pmdp, policy.weights)))
            every = jax.tree.map(lambda *a: np.concatenate(a)[: config.episodes], *found)
            evaluation.check(every, name)
            found_of = evaluation.summarise(every, run.config.penalty)
            rows.append({"policy": name, "shield": shown, **found_of})
        bar("episodes", total, total, "")
    return rows


def show(rows: Sequence[dict[str, Any]]) -> None:
    """Prints the table."""
    shown = [
        {
            "policy": row["policy"],
            "shield": row["shield"],
            "crashes": f"{row['crashes']:,}",
            **tables.rates(row),
            "return": tables.earned(row),
            "replaced %": f"{100 * row['interventions']:.1f}",
        }
        for row in rows
    ]
    title = f"Jam in brax, {rows[0]['episodes']:,} episodes each"
    terminal.table(title, shown, list(shown[0]))


def main(argv: Sequence[str] | None = None) -> Path:
    """Runs the command; exits with 2 on bad input."""
    config = tyro.cli(Config, args=argv, description=__doc__)
    with errors.bad_input():
        run = prepared(config)
        folder = storage.new_folder(config.out or default_out("shielded-jam"))
    with errors.bad_input():
        rows = compare(config, run._replace(folder=folder))
    show(rows)
    storage.write_json(folder / "config.json", dataclasses.asdict(config))
    storage.write_json(folder / "table.json", rows)
    terminal.say(f"results: {folder}")
    return folder


if __name__ == "__main__":
    main()
