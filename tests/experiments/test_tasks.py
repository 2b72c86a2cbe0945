import dataclasses
import shutil
import types
from pathlib import Path

import jax
import numpy as np
import pytest

import rp_jax
from examples.crossing import run as crossing
from examples.trolley import run as trolley
from experiments import ablation, circuit, jam, patrol, pipeline, settings, tasks
from rp_jax.envs import circuit as world
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
        ("insecure_penalty", (-1.0, float("inf"))),
        ("baseline", ("brave", "")),
        ("episodes", (0, -10, 2.5)),
        ("fidelity", ("text", "")),
        ("hide_position", (-0.1, 1.5, float("nan"))),
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
    def hide_position(**changes):
        task = circuit.make_task(circuit.Config(**changes))
        return float(task.train.hide_position), {
            name: float(p.hide_position) for name, p in task.tests.items()
        }

    assert hide_position() == (0.0, {"default": 0.0, "narrowed": 0.0, "circle": 0.0})
    assert hide_position(hide_position=0.25) == (
        0.25,
        {"default": 0.0, "narrowed": 0.0, "circle": 1.0},
    )
    swapped = {"track": "circle", "test_tracks": ("circle", "narrowed")}
    assert hide_position(hide_position=0.25, **swapped) == (0.25, {"circle": 0.0, "narrowed": 1.0})


def test_the_threshold_is_nowhere_above_what_was_asked_for():
    task = circuit.make_task(circuit.Config())
    for x in (0.1, 0.001, 0.9, 0.0, float("inf")):
        config = dataclasses.replace(circuit.Config(), x=x)
        members = tasks.members_of(config)
        pmdp = tasks.make_pmdp(task, config, None, task.train)
        for found in (pmdp.x, tasks.side_by_side(pmdp, members)[0].x[0]):
            assert found.dtype == np.float32
            assert float(found) <= x
            assert float(np.nextafter(np.asarray(found), np.float32(np.inf))) > x or x == np.inf


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tests": {}}, r"^tests is \{\}; the task must name at least one variant"),
        ({"threats": {}}, "^kind of hazard of circuit is 'wall'; it must be one of"),
        (
            {"env": types.SimpleNamespace(**{**vars(world), "LIDAR_BINS": 100})},
            "^LIDAR_BINS is 100; it must be a multiple of 8",
        ),
    ],
)
def test_a_task_that_is_not_whole_is_refused_before_any_work(changes, message):
    make = lambda config: circuit.make_task(config)._replace(**changes)  # noqa: E731
    with pytest.raises(ValueError, match=message):
        pipeline.checked(make, circuit.Config())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--x", "inf"], "x is inf; it must be a finite number"),
        (["--learning-penalty", "5"], "learning_penalty is 5.0; it must be"),
        (["--learning-penalty-from", "5"], "learning_penalty_from is 5.0; it must be one of None"),
    ],
)
def test_comparisons_of_shields_set_the_penalty_themselves(words, message, tmp_path, capsys):
    argv = [*words, "--out", str(tmp_path / "new")]
    with pytest.raises(SystemExit, match="2"):
        ablation.main("experiments.patrol", "", jam.PRESETS, patrol.make_task, argv)
    assert message in " ".join(capsys.readouterr().out.split())
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("module", "changes"),
    [
        (crossing, {"baseline": "plans"}),
        (crossing, {"fidelity": "paper"}),
        (crossing, {"test_pedestrians": (0,)}),
        (trolley, {"baseline": "plans"}),
    ],
)
def test_worlds_of_ones_own_refuse_what_they_have_not(module, changes):
    config = dataclasses.replace(module.quick("tuned"), **changes)
    with pytest.raises(ValueError, match=r"^(baseline|fidelity|pedestrians) is .*; it must be"):
        module.make_task(config)
    with pytest.raises(ValueError, match=r"^recipe is 'paper'; it must be one of 'tuned'"):
        module.quick("paper")


def test_the_code_of_a_run_is_also_that_of_its_own_world(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    folder = tmp_path / "odd_world"
    folder.mkdir()
    for name in ("__init__.py", "world.py", "run.py"):
        (folder / name).write_text("")
    code = settings.code.__wrapped__
    before = code("odd_world.run")
    assert before == code("odd_world.run")
    (folder / "world.py").write_text("GRAVITY = 2")
    assert code("odd_world.run") != before
    assert code("experiments.jam") == code("experiments.mpc") == code("no.such.module")
    (folder / "report.py").write_text("TALLY = 1")  # what is named like this is no drawing there
    grown = code("odd_world.run")
    (folder / "report.py").write_text("TALLY = 2")
    assert code("odd_world.run") != grown
    assert code("examples.crossing.run") not in (code("experiments.jam"), before)


def test_the_code_of_a_run_is_that_of_the_library_but_for_drawing(tmp_path, monkeypatch):
    copy = tmp_path / "plot" / "rp_jax"  # a checkout in a folder of that name
    shutil.copytree(Path(rp_jax.__file__).parent, copy)
    monkeypatch.setattr(rp_jax, "__file__", str(copy / "__init__.py"))
    code = settings.code.__wrapped__
    before = code("experiments.jam")
    (copy / "plot" / "curves.py").write_text("")
    assert code("experiments.jam") == before
    (copy / "threat" / "report.py").write_text("")
    assert code("experiments.jam") != before
