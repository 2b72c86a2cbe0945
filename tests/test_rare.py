"""Multilevel splitting, against crash probabilities known exactly."""

import jax
import jax.numpy as jnp
import numpy as np
import probe
import pytest
from scipy import stats

from rp_jax import rare
from rp_jax.planning.pmdp import PMDP

SLIP, LIMIT = 0.85, 8
EXACT = np.mean([stats.binom.sf(5 - start, LIMIT, 1 - SLIP) for start in probe.STARTS])


class Graded(PMDP):
    """Threat grows towards the pit; nothing is forbidden."""

    def _total(self, states, alive=None):
        cell = states.body.position[:, 0] / 10
        return jnp.tile(cell[:, None], (1, 3))


def make_graded(**params):
    like = probe.make_pmdp(probe, probe.make_params(slip=SLIP, time_limit=LIMIT, **params), pool=1)
    fields = {name: getattr(like, name) for name in like.__dataclass_fields__}
    return Graded(**{**fields, "x": jnp.asarray(jnp.inf, jnp.float32)})


def rightwards(percept):
    """Always to the pit; only the slips keep it away."""
    return jnp.tile(jnp.asarray([0.0, 0.0, 1.0]), (percept.secure.shape[0], 1))


STAGE = rare.compiled(rightwards)


@pytest.mark.parametrize("levels", [(), (0.35,), (0.35, 0.45, 0.55), (0.1, 0.5, 0.9)])
def test_the_estimate_is_unbiased_whatever_the_levels(levels):
    pmdp, runs = make_graded(), 150
    found = [
        rare.splitting(jax.random.key(i), pmdp, rightwards, levels, 50, stage=STAGE).estimate
        for i in range(runs)
    ]
    assert abs(np.mean(found) - EXACT) < 4 * np.std(found) / np.sqrt(runs)
    assert np.std(found) / np.sqrt(runs) < 0.1 * EXACT  # or the test could not fail


def test_levels_lessen_the_spread_of_rare_events():
    pmdp = make_graded().replace(params=probe.make_params(slip=0.95, time_limit=LIMIT))
    spread = {}
    for levels in ((), (0.45, 0.55)):
        runs = [
            rare.splitting(jax.random.key(i), pmdp, rightwards, levels, 50, stage=STAGE)
            for i in range(100)
        ]
        steps = np.mean([run.steps for run in runs])
        spread[levels] = np.std([run.estimate for run in runs]) * np.sqrt(steps)
    assert spread[(0.45, 0.55)] < spread[()]


def test_the_risk_of_an_action_is_that_of_what_comes_after_it():
    pmdp = make_graded()
    cells, times = np.asarray([2, 4, 5, 1]), np.asarray([0, 0, 5, 2])
    states = jax.vmap(probe.start_at)(jnp.asarray(cells, float))
    states = states.replace(time=jnp.asarray(times, jnp.int32))
    actions = jnp.tile(jnp.asarray([[probe.RIGHT, probe.STAY, probe.LEFT]]), (4, 1))
    tries = 4000
    measure = jax.jit(rare.risks, static_argnums=(4, 5))
    found = measure(jax.random.key(0), states, actions, pmdp, rightwards, tries)

    def exact(cell, time):
        """The probability to get to the pit at 6 from there, always walking right."""
        if cell >= 6:
            return 1.0
        return stats.binom.sf(5 - cell, LIMIT - time, 1 - SLIP) if cell > 0 else 0.0

    expected = np.zeros((4, 3))
    for i, (cell, time) in enumerate(zip(cells, times, strict=True)):
        stay = exact(cell, time + 1)
        for j, way in enumerate((1, 0, -1)):
            expected[i, j] = (1 - SLIP) * exact(cell + way, time + 1) + SLIP * stay
    expected[:, 1] = [exact(c, t + 1) for c, t in zip(cells, times, strict=True)]
    noise = np.sqrt(expected * (1 - expected) / tries)
    assert (np.abs(found - expected) <= 4 * noise + 1e-6).all()
    assert found[2, 0] > found[2, 1] > found[2, 2]


def test_nothing_that_crashes_gives_zero_and_no_starts():
    pmdp = make_graded().replace(params=probe.make_params(slip=1.0, time_limit=LIMIT))
    found = rare.splitting(jax.random.key(0), pmdp, rightwards, (0.35, 0.55), 50, stage=STAGE)
    assert found.estimate == 0
    assert found.starts is None
    assert found.rates[-1] == 0


def test_rates_multiply_and_starts_are_those_of_the_crashed():
    pmdp = make_graded()
    found = rare.splitting(jax.random.key(1), pmdp, rightwards, (0.35, 0.55), 200, stage=STAGE)
    assert len(found.rates) == 3
    assert found.estimate == pytest.approx(np.prod(found.rates))
    cells = found.starts.body.position[:, 0]
    assert len(cells) == round(200 * found.rates[-1])
    assert set(cells) <= set(map(float, probe.STARTS))
    assert (found.starts.time == 0).all()


def test_a_path_stops_where_it_reaches_the_level_and_no_later():
    pmdp = make_graded()
    paths = rare.begin(jax.random.key(2), pmdp, 100)
    stopped = STAGE(jax.random.key(3), paths, pmdp, jnp.asarray(0.45, jnp.float32))
    reached = np.asarray(stopped.reached)
    cells = np.asarray(stopped.states.body.position[:, 0])
    assert reached.any()
    assert not reached.all()
    assert (cells[reached] == 5).all()
    time = np.asarray(stopped.states.time)
    assert (time[~reached] == LIMIT).all()  # what is reached as the episode ends leads nowhere
    assert (time[reached] < LIMIT).all()
    assert not stopped.crashed.any()
    on = rare.resample(jax.random.key(4), stopped)
    assert (np.asarray(on.states.body.position[:, 0]) == 5).all()


def test_levels_of_a_pilot_run_ascend_and_are_left_behind_by_a_share():
    pmdp = make_graded()
    levels, steps = rare.choose_levels(jax.random.key(5), pmdp, 500, STAGE)
    assert steps > 500 * len(levels)
    assert levels == sorted(set(levels))
    assert levels
    assert all(0 < level < 0.6 for level in levels)


def test_levels_that_do_not_ascend_are_refused():
    with pytest.raises(ValueError, match=r"levels is .*must ascend"):
        rare.splitting(jax.random.key(0), make_graded(), rightwards, (0.5, 0.5), 10)
