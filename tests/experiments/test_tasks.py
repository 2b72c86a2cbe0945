import jax
import numpy as np
import pytest

from experiments import circuit, tasks
from rp_jax.planning import loop


@pytest.mark.parametrize(
    ("field", "values"),
    [
        ("seeds", (0, -3, 1.5, 10**6)),
        ("seed", (-1, 2**31)),
        ("x", (-0.1, float("nan"))),
        ("penalty", (-1.0, float("inf"))),
        ("learning_penalty", (-1.0, float("nan"))),
        ("learning_penalty_from", (-1.0, float("inf"))),
        ("learning_toll", (-1.0, float("inf"))),
        ("baseline", ("brave", "")),
        ("episodes", (0, -10, 2.5)),
        ("fidelity", ("text", "")),
        ("lost", (-0.1, 1.5, float("nan"))),
        ("planning", (loop.LoopConfig(steps=7), loop.LoopConfig(num_envs=0))),
    ],
)
def test_settings_out_of_range_are_named(field, values):
    circuit.Config().validate()
    circuit.Config(x=float("inf"), learning_penalty=0.0, seed=2**31 - 1001).validate()
    for value in values:
        with pytest.raises(ValueError, match=rf"^{field}.* is .*; it must be"):
            circuit.Config(**{field: value}).validate()


def test_no_two_uses_of_seeds_share_a_key():
    streams = (
        *(tasks.THREAT, tasks.SUMS, tasks.PLANNING, tasks.EVALUATION),
        *(tasks.STARTS, tasks.MEDIA, tasks.CERTIFICATE, tasks.RARE, tasks.CRASHES),
    )
    data = [
        tuple(np.asarray(jax.random.key_data(tasks.key_of(seed, stream))).tolist())
        for seed in range(20)
        for stream in streams
    ]
    assert len(set(data)) == 20 * len(streams)


def test_methods_are_named_by_what_sets_them_apart():
    name = lambda **changes: tasks.method_name(circuit.Config(**changes))  # noqa: E731
    assert name(x=0.001) == "RP (x=0.001)"
    assert name(x=0.001, learning_penalty=5.0) == "RP (x=0.001, 5)"
    assert name(x=float("inf"), learning_penalty=50.0) == "DQN (penalty 50)"


def test_what_learned_to_do_without_x_and_y_is_told_them_only_on_its_own_track():
    def lost(**changes):
        task = circuit.make_task(circuit.Config(**changes))
        return float(task.train.lost), {name: float(p.lost) for name, p in task.tests.items()}

    assert lost() == (0.0, {"default": 0.0, "narrowed": 0.0, "circle": 0.0})
    assert lost(lost=0.25) == (0.25, {"default": 0.0, "narrowed": 0.0, "circle": 1.0})
    swapped = {"track": "circle", "test_tracks": ("circle", "narrowed")}
    assert lost(lost=0.25, **swapped) == (0.25, {"circle": 0.0, "narrowed": 1.0})
