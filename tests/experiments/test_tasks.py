"""What the paper's tasks are made of, and that all of it is checked before any work."""

import dataclasses
import types

import pytest

from experiments import circuit
from experiments.tasks import EXPERIMENTS
from rp_jax.cli.experiment import threats_of
from rp_jax.envs import circuit as world
from rp_jax.planning.loop import LoopConfig
from rp_jax.runs import train
from rp_jax.runs.train import Process


def checked(config, **changes):
    made = circuit.make_world(config)._replace(**changes)
    return train.checked(made, config, threats_of(config), Process())


@pytest.mark.parametrize(
    ("field", "values"),
    [
        ("seeds", (0, -3, 1.5, 10**6)),
        ("seed", (-1, 2**31)),
        ("x", (-0.1, float("nan"))),
        ("penalty", (-1.0, float("inf"))),
        ("learning_penalty", (-1.0, float("nan"))),
        ("learning_penalty_from", (-1.0, float("inf"))),
        ("insecure_penalty", (-1.0, float("inf"))),
        ("baseline", ("brave", "")),
        ("episodes", (0, -10, 2.5)),
        ("fidelity", ("text", "")),
        ("hide_position", (-0.1, 1.5, float("nan"))),
        ("planning", (LoopConfig(steps=7), LoopConfig(num_envs=0))),
    ],
)
def test_settings_out_of_range_are_named(field, values):
    for value in values:
        with pytest.raises(ValueError, match=rf"^{field}.* is .*; it must be"):
            checked(circuit.Config(**{field: value}))


def test_settings_at_the_ends_of_their_ranges_are_taken():
    checked(circuit.Config(x=float("inf"), learning_penalty=0.0, seed=2**31 - 1001))


def test_what_learned_to_do_without_x_and_y_is_told_them_only_on_its_own_track():
    def hidden(**changes):
        made = circuit.make_world(circuit.Config(**changes))
        tests = {name: float(made.params(name).hide_position) for name in made.tests}
        return float(made.params().hide_position), tests

    assert hidden() == (0.0, {"default": 0.0, "narrowed": 0.0, "circle": 0.0})
    assert hidden(hide_position=0.25) == (
        0.25,
        {"default": 0.0, "narrowed": 0.0, "circle": 1.0},
    )
    swapped = {"track": "circle", "test_tracks": ("circle", "narrowed")}
    assert hidden(hide_position=0.25, **swapped) == (0.25, {"circle": 0.0, "narrowed": 1.0})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tests": {}}, r"^tests is \{\}; the world must have at least one"),
        (
            {"env": types.SimpleNamespace(**{**vars(world), "LIDAR_BINS": 100})},
            "^.*LIDAR_BINS is 100; it must be a multiple of 8",
        ),
    ],
)
def test_a_world_that_is_not_whole_is_refused_before_any_work(changes, message):
    with pytest.raises(ValueError, match=message):
        checked(circuit.Config(), **changes)


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_each_kind_of_hazard_has_settings_in_both_recipes(name):
    module = EXPERIMENTS[name]
    for recipe in ("tuned", "paper"):
        config = module.full(recipe)
        made = module.make_world(config)
        assert made.name == name
        assert set(threats_of(config)) == set(made.env.sub_rmdps(made.params()))
    quick = module.quick("tuned")
    assert dataclasses.replace(module.full("tuned"), seeds=1, episodes=quick.episodes) == quick
