"""reconnoitre, plan, evaluate, certify, save and load on the corridor of tests/probe.py."""

import dataclasses
import functools
import json
import re
import subprocess
import sys
import types

import jax
import jax.numpy as jnp
import numpy as np
import probe
import pytest
from quick import stopped_after
from tiny import programs_of_a_moment  # noqa: F401

import rp_jax
from rp_jax import LoopConfig, ThreatConfig
from rp_jax.envs import jam
from rp_jax.planning.pmdp import PMDP
from rp_jax.runs.saved import about_agents
from rp_jax.storage import PrecisionWarning, StorageError
from rp_jax.streams import Stream, key_of
from rp_jax.threat.fit import FitConfig

SMALL = ThreatConfig(
    states=400,
    sampling="uniform",
    miss_rate=1.0,
    test_states=50,
    fit=FitConfig(hidden=(16,), steps=2000, batch=64, learning_rate=1e-2),
)
LEARNER = LoopConfig(steps=600, num_envs=8, batch=16, n_step=2, replay=256, replay_start=32)
KEY = jax.random.key(0)
STARTS = jax.vmap(probe.start_at)(jnp.arange(2.0, 5.0))


def same(one, other):
    jax.tree.map(np.testing.assert_array_equal, one, other)


@pytest.fixture(scope="module")
def params():
    return probe.make_params(slip=0.2)


@pytest.fixture(scope="module")
def threat(params):
    return rp_jax.reconnoitre(KEY, probe, params, config=SMALL, x=0.5)


@pytest.fixture(scope="module")
def agents(params, threat):
    return rp_jax.plan(KEY, probe, params, threat, x=0.5, seeds=2, config=LEARNER)


def test_every_name_of_the_front_door_is_there():
    for name in rp_jax.__all__:
        assert getattr(rp_jax, name).__doc__
        assert name in dir(rp_jax)
    assert len(rp_jax.__all__) <= 25
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        rp_jax.nothing  # noqa: B018


def test_importing_it_loads_nothing_that_is_heavy():
    heavy = ("jax", "flax", "brax", "matplotlib", "gymnasium", "tyro", "rich", "scipy", "flashbax")
    code = f"import rp_jax, sys; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_threat_function_says_how_good_it_is(threat):
    assert set(threat.models) == set(threat.subs) == {"pit"}
    assert threat.about["reports"]["pit"]["mae"] < 0.1
    assert threat.about["sums"]["pit"]["unsafe"] >= 0


def test_agents_act_in_one_state_or_many(agents):
    actions = agents[0].act(STARTS)
    assert actions.shape == (3,)
    one = jax.tree.map(lambda a: a[1], STARTS)
    assert agents[0].act(one) == actions[1]
    percept = agents[0].look(STARTS)
    assert percept.admissible[jnp.arange(3), actions].all()
    assert [agent.pmdp.x for agent in agents] == [0.5, 0.5]
    assert len(agents[1:]) == 1
    same(agents[1:][0].weights, agents[1].weights)


def test_agent_i_is_the_same_whoever_learns_beside_it(params, threat, agents):
    alone = rp_jax.plan(KEY, probe, params, threat, x=0.5, seeds=[1], config=LEARNER)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5),
        alone[0].weights,
        agents[1].weights,
    )
    assert alone.members[0].seed == 1


def test_several_thresholds_learn_side_by_side(params, threat):
    several = rp_jax.plan(KEY, probe, params, threat, x=(0.1, 0.5), seeds=2, config=LEARNER)
    assert [(m.x, m.seed) for m in several.members] == [(0.1, 0), (0.1, 1), (0.5, 0), (0.5, 1)]
    assert several.methods[0] == "RP (x=0.1)"
    free = rp_jax.plan(KEY, probe, params, learning_penalty=(0.0, 9.0), config=LEARNER)
    assert free.methods == ["DQN (penalty 0)", "DQN (penalty 9)"]
    assert free[0].look(STARTS).admissible.all()


def test_one_agent_keeps_whatever_danger_it_is_promised(params, threat, tmp_path):
    """It learns with budgets from .05 to .5, and comes back from a file with them."""
    found = rp_jax.plan(KEY, probe, params, threat, c=(0.05, 0.5), refunds=2, config=LEARNER)
    assert found.methods == ["RP (c=0.05 to 0.5)"]
    assert found.promised == pytest.approx((0.05, 0.5))
    rp_jax.save(tmp_path, found)
    loaded = rp_jax.load(tmp_path, probe, params)
    assert (loaded.promised, loaded.pmdp.refunds) == (found.promised, 2)
    for agents in (found, loaded):
        (row,) = rp_jax.evaluate(KEY, agents, c=0.25, episodes=40)
        assert (row["env"], row["promised"]) == ("probe", 0.25)
        assert row["method"] == "RP (c=0.25)"
        assert row["danger_mean"] <= 0.25
        assert np.isfinite(row["booked_mean"])
    assert "danger promised, at most" in rp_jax.runs.tables.in_words(row)
    with pytest.raises(ValueError, match=r"^c is 0.1, but these agents learned without"):
        rp_jax.plan(KEY, probe, params, threat, x=0.5, config=LEARNER).in_world(c=0.1)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"c": 0.0}, "^c is 0.0; it must be"),
        ({"c": -1.0}, "^c is -1.0"),
        ({"c": float("nan")}, "^c is nan"),
        ({"c": float("inf")}, "^c is inf"),
        ({"c": (0.1, 0.01)}, "^c is .*; the first number must not be greater"),
        ({"c": (0.1, 0.2, 0.3)}, "^c has 3 values"),
        ({"c": 0.1, "x": float("inf")}, "^x is inf, which forbids nothing; beside c it must be"),
        ({"c": 0.1, "refunds": -1}, "^refunds is -1"),
    ],
)
def test_promises_that_make_no_sense_are_refused(given, words, params, threat):
    with pytest.raises(ValueError, match=words):
        rp_jax.plan(KEY, probe, params, threat, config=LEARNER, **given)


def test_a_promise_needs_threats_and_must_be_possible(params, threat):
    with pytest.raises(ValueError, match=r"^c is 0.1, but there is no threat"):
        rp_jax.plan(KEY, probe, params, c=0.1, config=LEARNER)
    grim = types.ModuleType("grim")
    vars(grim).update(vars(probe), reset=lambda key, params: probe.start_at(probe.PIT))
    with pytest.raises(ValueError, match=r"^c is 0.1; it must be 1 or more: so much danger"):
        rp_jax.plan(KEY, grim, params, threat, c=0.1, config=LEARNER)


def test_progress_and_metrics_come_through_callbacks(params, threat):
    told, rows = [], []
    rp_jax.plan(
        *(KEY, probe, params, threat),
        x=0.5,
        config=LEARNER,
        on_progress=lambda *facts: told.append(facts),
        on_metrics=rows.append,
    )
    stage, done, total, note = told[-1]
    assert (stage, done) == ("planning", total)
    assert "return" in note or "no episode" in note
    assert [row["steps"] for row in rows] == sorted(row["steps"] for row in rows)
    assert len(rows) == total


def test_a_table_has_a_row_per_agent_and_prints(agents):
    table = rp_jax.evaluate(KEY, agents, episodes=50, penalty=10.0, name="narrow")
    assert [row["seed"] for row in table] == [0, 1]
    assert {row["variant"] for row in table} == {"narrow"}
    (summary,) = table.summary
    assert summary["episodes"] == 100
    assert len(str(table).splitlines()) == 4
    again = rp_jax.evaluate(KEY, agents[1:], episodes=50, penalty=10.0)
    assert again[0]["return_mean"] == pytest.approx(table[1]["return_mean"])
    other = rp_jax.evaluate(KEY, agents, params=probe.make_params(slip=0.9), episodes=50)
    assert other[0]["steps"] != table[0]["steps"]


def test_a_certificate_is_planned_before_it_is_tested(agents):
    plans = []
    found = rp_jax.certify(
        KEY, agents, c=0.9, confidence=0.9, expected=0.5, on_plan=lambda *p: plans.append(p)
    )
    assert plans == [(found.planned_episodes, found.allowed_crashes)]
    assert found.shown == (found.crashes <= found.allowed_crashes)
    assert str(found).startswith("SHOWN" if found.shown else "NOT SHOWN")


def test_saved_agents_act_alike_in_another_process(agents, tmp_path):
    rp_jax.save(tmp_path / "kept", agents, {"slip": 0.2})
    code = (
        "import sys, jax, jax.numpy as jnp; sys.path[:0] = sys.argv[2:]\n"
        "import rp_jax, probe\n"
        "agents = rp_jax.load(sys.argv[1])\n"
        "states = jax.vmap(probe.start_at)(jnp.arange(2.0, 5.0))\n"
        "print(float(agents.pmdp.params.slip), *agents[1].act(states))"
    )
    path = str(probe.__file__).rpartition("/")[0]
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "kept"), path], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    slip, *actions = done.stdout.split()
    assert float(slip) == pytest.approx(0.2)
    assert [int(a) for a in actions] == agents[1].act(STARTS).tolist()


def test_parameters_that_settings_do_not_tell_come_back_too(params, threat, tmp_path):
    changed = params.replace(bait=jnp.asarray(7.0), slip=jnp.asarray(0.6))
    learner = dataclasses.replace(LEARNER, steps=100)
    agents = rp_jax.plan(KEY, probe, changed, threat, x=0.5, config=learner)
    rp_jax.save(tmp_path, agents)
    again = rp_jax.load(tmp_path, probe)
    same(again.pmdp.params, changed)
    assert again.pmdp.insecure_penalty == agents.pmdp.insecure_penalty
    assert again.config == learner
    same(again.weights, agents.weights)


def test_a_world_that_cannot_be_found_must_be_given(agents, tmp_path):
    class World:
        def __getattr__(self, name):
            if name in ("make_params", "__name__", "__file__"):
                raise AttributeError(name)
            return getattr(probe, name)

    env = World()
    lonely = dataclasses.replace(agents, pmdp=agents.pmdp.replace(env=env))
    rp_jax.save(tmp_path, lonely)
    with pytest.raises(StorageError, match="cannot be imported"):
        rp_jax.load(tmp_path)
    with pytest.raises(StorageError, match="the parameters cannot be made anew"):
        rp_jax.load(tmp_path, env)
    same(rp_jax.load(tmp_path, env, agents.pmdp.params).weights, agents.weights)


def test_a_threat_function_is_saved_and_loaded_alone(threat, params, tmp_path):
    rp_jax.save(tmp_path, threat)
    again = rp_jax.load(tmp_path, probe, params)
    same(again.models, threat.models)
    assert again.about["reports"]["pit"] == pytest.approx(threat.about["reports"]["pit"])
    wide = params.replace(pit=params.pit.replace(radius=jnp.asarray(0.9)))
    with pytest.raises(StorageError, match=r"pit: source/radius is 0\.5"):
        rp_jax.load(tmp_path, probe, wide)
    with pytest.raises(StorageError, match=r"threat: pit: source/radius is 0\.5"):
        rp_jax.plan(KEY, probe, wide, threat, x=0.5, config=LEARNER)


def call(folder, params, **more):
    threat = rp_jax.reconnoitre(
        KEY, probe, params, config=SMALL, x=0.5, folder=folder / "threat", **more
    )
    learner = dataclasses.replace(LEARNER, steps=400)
    return rp_jax.plan(
        KEY, probe, params, threat, x=0.5, seeds=2, config=learner, folder=folder, **more
    )


def test_the_same_call_goes_on_to_the_same_bits_and_is_done_once(params, tmp_path, monkeypatch):
    alone = call(tmp_path / "alone", params)
    folder = tmp_path / "run"
    stops = 0
    for steps in (3, 20, 2, 9):
        with stopped_after(steps, monkeypatch):
            try:
                call(folder, params)
            except KeyboardInterrupt:
                stops += 1
    assert stops >= 2
    found = call(folder, params)
    same(found.weights, alone.weights)
    assert not (folder / "checkpoints").exists()
    told = []
    again = call(folder, params, on_progress=lambda *facts: told.append(facts))
    assert told == []  # nothing was done again
    same(again.weights, alone.weights)
    assert len(again.history) == len(alone.history)


def test_saving_again_replaces_the_threat_function_too(agents, params, tmp_path):
    other = rp_jax.reconnoitre(jax.random.key(7), probe, params, config=SMALL, x=0.5)
    changed = dataclasses.replace(
        agents, threat=other, pmdp=agents.pmdp.replace(threats=dict(other.models))
    )
    for which in (agents, changed):
        rp_jax.save(tmp_path, which)
        loaded = rp_jax.load(tmp_path, probe, params)
        same(loaded.threat.models["pit"].params, which.threat.models["pit"].params)
        same(loaded.pmdp.threat(STARTS), which.pmdp.threat(STARTS))
        np.testing.assert_equal(loaded.history, agents.history)
    agents.threat.save(tmp_path / "threat")  # one of them alone
    with pytest.raises(
        StorageError, match=r"checksum is \w+; it must be \w+, that of the one which"
    ):
        rp_jax.load(tmp_path, probe, params)
    with pytest.raises(ValueError, match="it holds a threat function with the checksum"):
        rp_jax.plan(KEY, probe, params, other, x=0.5, config=LEARNER, folder=tmp_path)


def test_a_folder_with_agents_and_a_threat_function_loads_the_agents(agents, params, tmp_path):
    agents.threat.save(tmp_path)
    rp_jax.save(tmp_path, agents)
    assert isinstance(rp_jax.load(tmp_path, probe, params), rp_jax.Agents)


def test_what_is_written_says_what_it_is(agents, threat):
    assert repr(agents) == "Agents(probe: 2 of RP (x=0.5))"
    assert repr(agents[0]) == "Agent(probe: RP (x=0.5))"
    jax.eval_shape(lambda agent: [repr(agent)] and agent.pmdp.x, agents[0])  # traced, as well
    assert re.fullmatch(r"ThreatFunction\(pit \(mean absolute error .* 0\.\d+\)\)", repr(threat))
    for config in (LoopConfig, ThreatConfig, FitConfig, rp_jax.DQNConfig):
        for field in dataclasses.fields(config):
            assert re.search(rf"\n +{field.name}: \S", config.__doc__), field.name


class Wider:
    """The corridor with an observation that is one number longer."""

    SCALE = ()

    def __getattr__(self, name):
        return getattr(probe, name)

    @staticmethod
    def observe(state, params):
        return jnp.append(probe.observe(state, params), 0.0)


class Fewer(Wider):
    """The corridor with two actions."""

    observe = staticmethod(probe.observe)
    num_actions = staticmethod(lambda params: 2)


def test_a_world_in_which_agents_cannot_act_is_refused(agents, params):
    few = params.replace(
        body=params.body.replace(actions=jax.tree.map(lambda a: a[:2], params.body.actions))
    )
    for world, given, says in (
        (Wider(), None, r"length of the observation is \d+; it must be \d+, as where the agents"),
        (Fewer(), few, "number of actions is 2; it must be 3"),
        (jam, None, "reset cannot be traced"),
        ("jam", None, "the environment has no function `reset`"),
    ):
        for call in (rp_jax.evaluate, functools.partial(rp_jax.certify, c=0.5)):
            with pytest.raises(ValueError, match=says):
                call(KEY, agents, world, given)


def test_another_horizon_is_another_job(params, tmp_path):
    rp_jax.reconnoitre(KEY, probe, params, config=SMALL, x=0.5, folder=tmp_path)

    class Longer(Wider):
        observe = staticmethod(probe.observe)
        __name__ = "probe"  # the same name, and other sub-R-MDPs

        @staticmethod
        def sub_rmdps(params):
            (sub,) = probe.sub_rmdps(params).values()
            longer = sub.source.replace(horizon=sub.source.horizon + 1)
            return {"pit": sub.replace(source=longer)}

    with pytest.raises(ValueError, match=r"folder is .*; its params is"):
        rp_jax.reconnoitre(KEY, Longer(), params, config=SMALL, x=0.5, folder=tmp_path)


def test_a_certificate_goes_on_where_it_was_interrupted(agents, tmp_path, monkeypatch):
    test = functools.partial(rp_jax.certify, KEY, agents, c=0.98, expected=0.975)
    alone, told = test(), []
    assert alone.episodes > 2000
    with stopped_after(1, monkeypatch), pytest.raises(KeyboardInterrupt):
        test(folder=tmp_path)
    count = lambda stage, done, total, note: told.append(done)  # noqa: E731
    assert test(folder=tmp_path, on_progress=count) == alone
    assert told[0] == 2
    assert not (tmp_path / "checkpoints").exists()


def test_a_folder_of_something_else_is_refused(params, tmp_path, monkeypatch):
    call(tmp_path, params)
    other = probe.make_params(slip=0.3)
    threat = rp_jax.load(tmp_path / "threat", probe, params)
    with pytest.raises(ValueError, match=r"folder is .*; its params is"):
        call(tmp_path, other)
    with pytest.raises(ValueError, match=r"its config: steps is 400; it must be 600"):
        rp_jax.plan(KEY, probe, params, threat, x=0.5, seeds=2, config=LEARNER, folder=tmp_path)
    with stopped_after(2, monkeypatch), pytest.raises(KeyboardInterrupt):
        rp_jax.reconnoitre(KEY, probe, params, config=SMALL, folder=tmp_path / "new")
    with pytest.raises(ValueError, match=r"its x is 0\.01; it must be 0\.5"):
        rp_jax.reconnoitre(KEY, probe, params, config=SMALL, x=0.5, folder=tmp_path / "new")
    spec = json.loads((tmp_path / "new" / "checkpoints" / "threat" / "spec.json").read_text())
    assert spec["x"] == 0.01


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"x": -0.1}, r"^x is -0\.1; it must be a number, at least 0"),
        ({"x": float("nan")}, r"^x is nan"),
        ({"seeds": 0}, r"^seeds is 0; it must be an integer, at least 1"),
        ({"seeds": [0, -1]}, r"^seeds is -1"),
        ({"seeds": [1, 2, 1]}, r"^seeds is \[1, 2, 1\]; each must be there once"),
        ({"config": SMALL}, r"^config is ThreatConfig.*; it must be a LoopConfig"),
        ({"x": ()}, r"^x, learning_penalty and seeds must each"),
        ({"x": (0.1, 0.2), "learning_penalty": (1.0, 2.0, 3.0)}, r"^learning_penalty has 3 values"),
        ({"lookahead": -1}, r"^lookahead is -1"),
        ({"penalty": -1.0}, r"^penalty is -1"),
        ({"insecure_penalty": float("inf")}, r"^insecure_penalty is inf"),
        ({"devices": "two"}, r"^devices is 'two'; it must be one of"),
        ({"config": LoopConfig(batch=0)}, r"^config.batch is 0"),
        ({"key": 0}, r"^key is 0; it must be one key of jax.random.key"),
        ({"threat": "results"}, r"^threat is str; it must be a ThreatFunction"),
    ],
)
def test_planning_names_what_is_out_of_range(change, says, params, threat):
    given = {"key": KEY, "env": probe, "params": params, "threat": threat, "x": 0.5, **change}
    with pytest.raises(ValueError, match=says):
        rp_jax.plan(**given)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"x": 0.0}, r"^x is 0\.0; it must be a finite number, above 0"),
        (
            {"config": {"lion": SMALL}},
            r"^config: kind of hazard is 'lion'; it must be one of 'pit'",
        ),
        ({"config": 3}, r"^config is 3; it must be a ThreatConfig"),
        ({"config": ThreatConfig(states=5)}, r"^pit.states is 5"),
        ({"devices": ""}, r"^devices is ''"),
    ],
)
def test_reconnaissance_names_what_is_out_of_range(change, says, params):
    with pytest.raises(ValueError, match=says):
        rp_jax.reconnoitre(**{"key": KEY, "env": probe, "params": params, **change})


def test_evaluation_and_saving_name_what_they_are_not_made_for(agents, tmp_path):
    with pytest.raises(ValueError, match=r"(?s)agents is .*; it must be Agents"):
        rp_jax.evaluate(KEY, agents.weights)
    with pytest.raises(ValueError, match="episodes is 0"):
        rp_jax.evaluate(KEY, agents, episodes=0)
    with pytest.raises(ValueError, match="agent is 2; it must be an integer, at least 0, at most"):
        rp_jax.certify(KEY, agents, c=0.5, agent=2)
    with pytest.raises(ValueError, match="c is 0"):
        rp_jax.certify(KEY, agents, c=0)
    with pytest.raises(ValueError, match="thing is one Agent"):
        rp_jax.save(tmp_path, agents[0])
    with pytest.raises(ValueError, match="thing is 3"):
        rp_jax.save(tmp_path, 3)
    with pytest.raises(StorageError, match="there is no such folder"):
        rp_jax.load(tmp_path / "nothing", probe)
    with pytest.raises(ValueError, match="folder is 3; it must be a path"):
        rp_jax.load(3)
    with pytest.raises(StorageError, match="it must hold agents or a threat function"):
        rp_jax.load(tmp_path, probe)
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match="file"):
        rp_jax.save(tmp_path / "file", agents)
    for nonsense in (jnp.zeros(3), 0, STARTS.body):
        with pytest.raises(ValueError, match=r"(?s)states is .*; it must be states of the env"):
            agents[0].act(nonsense)
    rp_jax.save(tmp_path / "mine", agents, {"slip": 0.2})
    with pytest.raises(StorageError, match="env is json; it must be an environment, but has no"):
        rp_jax.load(tmp_path / "mine", json)
    with pytest.raises(
        StorageError, match=r"settings .* do not fit rp_jax\.envs\.jam\.make_params"
    ):
        rp_jax.load(tmp_path / "mine", jam)


def test_plain_numbers_are_good_scalars(params, threat):
    pmdp = PMDP(params, dict(threat.models), 0.5, 0.0, 0.0, probe)
    exact = pmdp.replace(x=jnp.asarray(0.5))
    same(pmdp.perceive(STARTS), exact.perceive(STARTS))
    free = PMDP(params, {}, float("inf"), 0.0, 0.0, probe, shielded=False)
    assert free.perceive(STARTS).admissible.all()


def test_streams_share_no_draw():
    keys = [jax.random.key_data(key_of(KEY, stream)).tolist() for stream in Stream]
    assert len({tuple(key) for key in keys}) == len(Stream)


def test_facts_of_agents_are_readable(agents, tmp_path):
    rp_jax.save(tmp_path, agents)
    about = about_agents(tmp_path)
    assert about["env"] == "probe"
    assert about["observation"] == {"scan": 2, "rest": 2}
    assert about["members"][1] == {"seed": 1, "x": 0.5, "learning_penalty": 0.0}


def loaded(folder, says):
    """What is in a folder of another precision, which a warning tells of."""
    with pytest.warns(PrecisionWarning, match=says):
        return rp_jax.load(folder, probe)


def test_agents_serve_in_another_precision_and_it_is_said_so(agents, tmp_path):
    """There and back: double precision holds all that single does."""
    rp_jax.save(tmp_path / "single", agents)  # slip is kept as an array: the settings are not given
    says = r"is float32\[.*, saved with jax_enable_x64=False; here it is float64"
    with jax.enable_x64(True):
        double = loaded(tmp_path / "single", says)
        starts = jax.vmap(probe.start_at)(jnp.arange(2.0, 5.0))
        assert double.pmdp.params.slip.dtype == np.float64
        assert double.pmdp.params.slip == np.float32(0.2)
        there = [agent.act(starts).tolist() for agent in double]
        rp_jax.save(tmp_path / "double", double)
    assert there == [agent.act(STARTS).tolist() for agent in agents]
    back = loaded(tmp_path / "double", "saved with jax_enable_x64=True; here it is float32")
    same(back.weights, agents.weights)
    same(back.pmdp.params, agents.pmdp.params)
    same(back.pmdp.threats, agents.pmdp.threats)
    assert back.pmdp.params.slip.dtype == np.float32


def test_a_threat_function_serves_in_another_precision(threat, tmp_path):
    rp_jax.save(tmp_path, threat)
    with jax.enable_x64(True):
        found = loaded(tmp_path, "saved with jax_enable_x64=False")
        assert found.models["pit"].source.radius.dtype == np.float64


def test_a_finished_job_of_another_precision_is_refused_by_its_name(threat, params, tmp_path):
    ask = functools.partial(rp_jax.plan, x=0.5, config=LEARNER, folder=tmp_path)
    ask(KEY, probe, params, threat)
    with jax.enable_x64(True), pytest.raises(ValueError, match="jax_enable_x64 is True here"):
        ask(jax.random.key(0), probe, probe.make_params(slip=0.2))
