import dataclasses
import json
import runpy

import jax
import jax.numpy as jnp
import numpy as np
import probe
import pytest
from quick import unoptimised

from benchmarks import adapters, env_step, measure, recon, setups, tabular, threat_query, train_step
from benchmarks.measure import Row
from experiments import circuit, jam, point_gather

MODULES = {"circuit": circuit, "jam": jam, "point_gather": point_gather}


@pytest.fixture(autouse=True, scope="module")
def programs_of_a_moment():
    """They need no optimising; flashbax needs rank promotion."""
    with unoptimised(), jax.numpy_rank_promotion("allow"):
        yield


def sane(row):
    assert 0 < row.slowest <= row.per_second <= row.fastest < float("inf")
    assert row.compile_seconds > 0
    assert row.peak_mib > 10
    return row


def test_a_program_is_compiled_once_and_timed_apart():
    traced = []

    def program(a, b):
        traced.append(a)
        return a @ b

    a = jnp.ones((8, 8))
    row = sane(measure.measure("product", "rows", 8, 800, program, a, a, repeats=3))
    assert len(traced) == 1
    assert (row.name, row.unit, row.batch) == ("product", "rows", 8)
    twice = measure.measure("product", "rows", 8, 800e9, program, a, a, repeats=3)
    assert twice.per_second > 1e3 * row.per_second  # it counts what it is told to


ROW = Row("what", "steps", 4, 2.0, 1.0, 3.0, 0.5, 100.0)


def test_rows_are_shown_and_written(tmp_path, capsys):
    measure.report("some", [ROW, ROW], tmp_path / "new")
    shown = capsys.readouterr().out
    assert "some" in shown
    assert "what" in shown
    found = json.loads((tmp_path / "new" / "some.json").read_text())
    assert found["rows"] == [dataclasses.asdict(ROW)] * 2
    assert found["machine"]["jax"] == jax.__version__
    assert found["machine"]["cores"] >= 1


def test_without_a_folder_nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    measure.report("some", [ROW], None)
    assert list(tmp_path.iterdir()) == []


def test_each_benchmark_has_a_command_line_that_is_read_first(tmp_path, monkeypatch):
    out = tmp_path / "results"
    monkeypatch.setattr("sys.argv", ["benchmarks.some", "--out", str(out)])
    measure.main("some", lambda: [ROW])
    assert [path.name for path in out.iterdir()] == ["some.json"]
    monkeypatch.setattr("sys.argv", ["benchmarks.some", "--help"])
    with pytest.raises(SystemExit) as stop:
        measure.main("some", lambda: pytest.fail("nothing is to be run"))
    assert stop.value.code == 0


def test_all_benchmarks_are_run_by_the_package(tmp_path, monkeypatch):
    for module in (env_step, recon, threat_query, train_step, tabular, adapters):
        monkeypatch.setattr(module, "run", lambda: [ROW])
    monkeypatch.setattr("sys.argv", ["benchmarks", "--out", str(tmp_path)])
    runpy.run_module("benchmarks", run_name="__main__")
    names = {"env_step", "recon", "threat_query", "train_step", "tabular", "adapters"}
    assert {path.stem for path in tmp_path.iterdir()} == names


@pytest.mark.parametrize("observed", [False, True])
def test_the_program_of_steps_takes_them(observed):
    params = probe.make_params()
    start = jax.vmap(probe.reset, (0, None))(jax.random.split(jax.random.key(0), 4), params)
    program = jax.jit(env_step.steps(probe, observed))
    states, total = program(start, jax.random.key(1), params)
    assert total.shape == (4,)
    assert (total > 0).all()  # in 100 steps at random, coins or pits are found
    assert (states.time < 12).all()  # episodes have begun afresh
    sane(measure.measure("probe", "steps", 4, 400, program, start, jax.random.key(1), params))


def tiny_tasks():
    """All tasks with networks and batches as small as they may be."""
    found = {}
    for name, module in MODULES.items():
        config = module.quick("tuned")
        small = lambda threat: dataclasses.replace(  # noqa: E731
            threat, fit=dataclasses.replace(threat.fit, hidden=(4,), batch=16)
        )
        kinds = {kind: small(getattr(config, kind)) for kind in module.make_task(config).threats}
        planning = dataclasses.replace(
            config.planning, num_envs=4, batch=8, replay=64, replay_start=8, n_step=1
        )
        config = dataclasses.replace(config, planning=planning, **kinds)
        found[name] = (module.make_task(config), config)
    return found


def test_the_setups_are_the_tuned_recipes():
    found = setups.tasks()
    assert set(found) == set(MODULES)
    for module in MODULES.values():
        task, config = found[module.__name__.split(".")[-1]]
        assert config == module.quick("tuned")
        assert set(task.threats) == set(task.env.sub_rmdps(task.train))


@pytest.mark.slow
def test_training_is_measured(monkeypatch):
    monkeypatch.setattr(train_step, "tasks", tiny_tasks)
    monkeypatch.setattr(train_step, "ITERATIONS", 2)
    rows = [sane(row) for row in train_step.run()]
    assert [row.batch for row in rows] == [4] * len(MODULES)
    assert [row.name.split(",")[0] for row in rows] == list(MODULES)


@pytest.mark.slow
def test_threat_queries_are_measured(monkeypatch):
    monkeypatch.setattr(threat_query, "tasks", tiny_tasks)
    rows = [sane(row) for row in threat_query.run((1, 4))]
    assert [(row.name, row.batch) for row in rows] == [
        (name, batch) for name in MODULES for batch in (1, 4)
    ]


@pytest.mark.slow
def test_reconnaissance_is_measured(monkeypatch):
    rows = [sane(row) for row in recon.run(64)]
    assert [row.unit for row in rows] == ["states"] + 2 * ["states", "simulated steps"]
    np.testing.assert_allclose(rows[2].per_second / rows[1].per_second, 64 * 15 * 5, rtol=0.9)


@pytest.mark.slow
def test_environments_are_measured():
    rows = [sane(row) for row in env_step.run(4)]
    assert len({row.name for row in rows}) == len(rows) == 12


def test_solving_cmdps_is_measured_beside_a_linear_program():
    rows = tabular.run(batches=(2,), programs=2)
    assert [row.name for row in rows] == ["Algorithm 1", "linear program"]
    assert all(0 < row.slowest <= row.per_second <= row.fastest for row in rows)


@pytest.mark.slow
def test_gymnasium_is_measured_beside_the_step_that_it_calls(monkeypatch):
    monkeypatch.setattr(adapters, "STEPS", 2)
    monkeypatch.setattr(adapters, "REPEATS", 2)
    rows = adapters.run(4)
    assert [row.unit for row in rows] == 2 * ["steps", "steps", "ratio"]
    assert all(0 < row.slowest <= row.per_second <= row.fastest for row in rows)


def test_programs_are_timed_by_turns():
    calls = []
    rates = adapters.alternated([lambda a: calls.append(("a", a)), calls.append], [1, 2])
    assert [len(found) for found in rates] == [adapters.REPEATS, adapters.REPEATS]
    assert calls[:8] == 2 * [("a", 1), ("a", 2), 1, 2]  # the first round warms up
