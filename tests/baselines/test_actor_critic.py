import dataclasses
import functools

import finite
import jax
import jax.numpy as jnp
import numpy as np
import probe
import pytest
from quick import compile_soon  # noqa: F401

from rp_jax import evaluation
from rp_jax.baselines import actor_critic
from rp_jax.baselines.actor_critic import ActorCriticConfig, Batch
from rp_jax.envs import jam
from rp_jax.tabular import cmdp

CONFIG = ActorCriticConfig(
    policy="categorical",
    num_envs=8,
    length=10,
    gamma=0.9,
    beta=0.8,
    trace=0.7,
    minibatches=4,
)

init = jax.jit(actor_critic.init, static_argnums=2)
collect = jax.jit(actor_critic.collect, static_argnums=3)


@functools.partial(jax.jit, static_argnums=3)
def fit(key, state, pmdp, config):
    """Collects and learns the values of an unchanging policy."""

    def one(state, key):
        collect_key, fit_key = jax.random.split(key)
        state, batch, _ = actor_critic.collect(collect_key, state, pmdp, config)

        def learn(state, part):
            return actor_critic.update_critic(state, part, pmdp, config)

        return actor_critic.pass_over(fit_key, state, batch, learn, config), None

    return jax.lax.scan(one, state, jax.random.split(key, 40))[0]


def slow_gae(signal, value, next_value, done, discount, trace):
    """The defining sum of temporal-difference errors, up to the first end."""
    advantages = []
    for t in range(len(signal)):
        total, weight = 0.0, 1.0
        for k in range(t, len(signal)):
            ahead = 0.0 if done[k] else next_value[k]
            total += weight * (signal[k] + discount * ahead - value[k])
            weight *= discount * trace
            if done[k]:
                break
        advantages.append(total)
    return np.asarray(advantages)


@pytest.mark.parametrize("seed", range(5))
def test_advantages_are_the_sums_that_define_them(seed):
    rng = np.random.default_rng(seed)
    signal, value, next_value = rng.normal(size=(3, 30))
    done = rng.random(30) < 0.2
    discount, trace = rng.uniform(0.5, 1.0, 2)
    arguments = [jnp.asarray(a) for a in (signal, value, next_value, done)]
    found = actor_critic.gae(*arguments, jnp.asarray(discount), trace)
    expected = slow_gae(signal, value, next_value, done, discount, trace)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


def test_without_a_critic_s_help_an_advantage_is_the_return():
    signal = jnp.asarray([1.0, 2.0, 4.0])
    nothing, never = jnp.zeros(3), jnp.zeros(3, bool)
    last = never.at[-1].set(True)
    found = actor_critic.gae(signal, nothing, nothing, last, jnp.asarray(0.5), 1.0)
    np.testing.assert_allclose(found, [1 + 1 + 1, 2 + 2, 4])


def chain(steps=5):
    """Deterministic: state t leads to t + 1; rewards and dangers tell the state."""
    kernel = np.zeros((steps + 1, 2, steps + 1))
    kernel[np.arange(steps), :, np.arange(steps) + 1] = kernel[steps, :, steps] = 1
    signal = np.repeat(np.arange(steps + 1.0)[:, None], 2, axis=1)
    return cmdp.make(kernel, 2 * signal, signal / 10, 0, gamma=1.0, beta=1.0, horizon=steps)


@pytest.mark.parametrize("limit", [3, 100])
def test_a_batch_holds_what_happened(limit):
    """After an end nothing counts, be it by the time limit or a true one."""
    model = chain()
    pmdp = finite.pmdp_of(model, limit)
    config = dataclasses.replace(CONFIG, trace=0.0)
    state = init(jax.random.key(0), pmdp, config)
    # A critic that says something of every state, in bold.
    bold = jax.tree.map(lambda a: 3 * a + 0.1, state.critic)
    state = state._replace(critic=bold)
    after, batch, metrics = collect(jax.random.key(1), state, pmdp, config)
    assert batch.encoded.rest.shape == (80, 30)
    where = np.asarray(batch.encoded.rest).argmax(axis=-1)
    time, index = where // 6, where % 6
    last = min(limit, 5) - 1
    np.testing.assert_array_equal(time, np.repeat(np.arange(10) % (last + 1), 8))
    np.testing.assert_array_equal(index, time)  # it is where it must be at that time
    critic, everywhere = actor_critic.make_critic(pmdp), finite.all_states(model)
    elapsed = actor_critic.elapsed_of(everywhere, pmdp)
    values = np.asarray(critic.apply(bold, pmdp.perceive(everywhere).encoded, elapsed)).reshape(
        5, 6, 2
    )
    ahead = np.append(np.diagonal(values).T[1:], np.zeros((1, 2)), axis=0)
    ahead[last] = 0.0
    earned = np.cumsum(2 * 0.9 ** -np.arange(5.0) * np.arange(5)) * 0.9 ** np.arange(5)
    scale = np.sqrt(np.mean(earned[time] ** 2))  # of all discounted rewards so far
    assert after.spread.scale == pytest.approx(scale, rel=1e-4)
    reward = 2 * time / scale
    target = np.stack([reward, time / 10], -1) + np.asarray([0.9, 0.8]) * ahead[time]
    np.testing.assert_allclose(batch.target, target, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(
        batch.advantage, batch.target - np.diagonal(values).T[time], rtol=1e-4, atol=1e-4
    )
    rounds = 10 // (last + 1)
    assert metrics.steps == 80
    assert metrics.episodes == 8 * rounds
    for name in ("steps", "episodes", "crashes", "goals"):
        assert getattr(metrics, name).dtype == np.int32, name
    assert metrics.score == 8 * rounds * 2 * sum(range(last + 1))
    assert metrics.danger == pytest.approx(8 * sum(np.arange(10) % (last + 1)) / 10, rel=1e-5)
    np.testing.assert_array_equal(after.states.time, np.full(8, 10 % (last + 1)))
    # The next batch goes on from there.
    _, batch, _ = collect(jax.random.key(2), after, pmdp, config)
    first = np.asarray(batch.encoded.rest[:8]).argmax(axis=-1) // 6
    np.testing.assert_array_equal(first, after.states.time)


@pytest.mark.parametrize("policy", ["gaussian", "categorical"])
def test_all_environments_serve_with_either_kind_of_action(policy):
    config = dataclasses.replace(CONFIG, policy=policy, num_envs=2, length=2)
    pmdp = probe.make_pmdp(jam, jam.make_params(3), x=np.inf)
    state = jax.eval_shape(lambda key: actor_critic.init(key, pmdp, config), jax.random.key(0))
    _, batch, _ = jax.eval_shape(
        lambda state: actor_critic.collect(jax.random.key(0), state, pmdp, config), state
    )
    assert batch.action.shape == ((4, 2) if policy == "gaussian" else (4,))
    assert batch.encoded.scan.shape == (4, 45)
    assert batch.advantage.shape == batch.target.shape == (4, 2)


VALUES = {
    "of the one step": (finite.bandit([1.0, 1.0], [0.3, 0.3]), 0.9, [[1.0, 0.3]]),
    "of what comes later, discounted": (chain(2), 0.5, [[0 + 0.5 * 2, 0.5 * 0.1], [2.0, 0.1]]),
}


@pytest.mark.parametrize("name", VALUES)
def test_the_critic_learns_values(name):
    model, discount, expected = VALUES[name]
    config = dataclasses.replace(CONFIG, gamma=discount, beta=discount, critic_rate=0.01)
    pmdp = finite.pmdp_of(model)
    state = fit(jax.random.key(1), init(jax.random.key(0), pmdp, config), pmdp, config)
    met = [t * model.shape[1] + t for t in range(len(expected))]
    states = finite.all_states(model)
    encoded, elapsed = pmdp.perceive(states).encoded, actor_critic.elapsed_of(states, pmdp)
    values = actor_critic.make_critic(pmdp).apply(state.critic, encoded, elapsed)
    values = values * jnp.stack([state.spread.scale, jnp.ones(())])[None]
    np.testing.assert_allclose(values[np.asarray(met)], expected, atol=0.05)


def test_a_pass_meets_every_step_once_in_another_order():
    rows = jnp.arange(80)
    batch = Batch(rows, rows, rows, rows, rows)
    config = dataclasses.replace(CONFIG, epochs=3)

    def note(carry, part):
        seen, count = carry
        return seen.at[count].set(part.action), count + 1

    begin = (jnp.zeros((12, 20), int), 0)
    seen, _ = actor_critic.pass_over(jax.random.key(0), begin, batch, note, config)
    passes = np.asarray(seen).reshape(3, 80)
    np.testing.assert_array_equal(np.sort(passes, axis=1), np.tile(rows, (3, 1)))
    assert (passes[0] != passes[1]).any()


def test_a_driver_draws_or_takes_the_mode():
    model = finite.bandit([0.0, 1.0, 0.5])
    pmdp = finite.pmdp_of(model)
    network = actor_critic.make_actor(pmdp, CONFIG)
    weights = init(jax.random.key(0), pmdp, CONFIG).actor
    weights["params"]["logits_out"]["bias"] = jnp.log(jnp.asarray([0.2, 0.7, 0.1]))
    weights["params"]["logits_out"]["kernel"] *= 0

    @functools.partial(jax.jit, static_argnums=2)
    def play(weights, pmdp, greedy):
        policy = actor_critic.driver(network, weights, greedy=greedy)
        return evaluation.play_episodes(jax.random.key(3), pmdp, policy, 2000, batch=1000)

    assert (play(weights, pmdp, True).score == 1).all()
    scores = np.asarray(play(weights, pmdp, False).score)
    shares = [(scores == score).mean() for score in (0.0, 1.0, 0.5)]
    np.testing.assert_allclose(shares, [0.2, 0.7, 0.1], atol=0.04)
    assert len(set(map(tuple, scores.reshape(2, 1000)))) == 2  # no key is used twice


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"policy": "beta"}, "policy"),
        ({"num_envs": 0}, "num_envs"),
        ({"length": 1.5}, "length"),
        ({"gamma": 1.1}, "gamma"),
        ({"beta": -0.1}, "beta"),
        ({"trace": float("nan")}, "trace"),
        ({"critic_rate": 0.0}, "critic_rate"),
        ({"epochs": 0}, "epochs"),
        ({"minibatches": 81}, "minibatches"),
        ({"minibatches": 3}, "minibatches"),
        ({"memory": 1.5}, "memory"),
    ],
)
def test_bad_settings_are_named(change, field):
    CONFIG.validate("rollout")
    with pytest.raises(ValueError, match=rf"^rollout\.{field} is .*must"):
        dataclasses.replace(CONFIG, **change).validate("rollout")
