import dataclasses
import json
import os
import runpy

import jax
import jax.numpy as jnp
import probe
import pytest
from quick import unoptimised

from benchmarks import (
    adapters,
    bound,
    compare,
    env_step,
    measure,
    recon,
    report,
    seeds,
    setups,
    tabular,
    threat_query,
    train_step,
)
from benchmarks.bound import Bound, Piece, Work
from benchmarks.measure import Row
from experiments.tasks import EXPERIMENTS
from rp_jax.cli.experiment import threats_of

HERE = ["--processes", "1"]
LIMITS = bound.Limits(operations=1e11, bytes=1e10)


@pytest.fixture(autouse=True, scope="module")
def programs_of_a_moment():
    """They need no optimising; flashbax needs rank promotion."""
    with unoptimised(), jax.numpy_rank_promotion("allow"):
        yield


@pytest.fixture(autouse=True)
def known_limits(monkeypatch):
    """Nothing depends on how fast this machine is."""
    for module in (bound, report):
        monkeypatch.setattr(module, "limits", lambda: LIMITS)


def sane(row):
    assert 0 < row.slowest <= row.per_second <= row.fastest < float("inf")
    assert row.compile_seconds > 0
    assert row.peak_mib > 10
    assert row.program_mib > 0
    assert row.bound.operations > 0
    assert row.bound.bytes > 0
    assert row.bound.memory == pytest.approx(row.bound.bytes * row.per_second / LIMITS.bytes)
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


def test_the_work_of_a_loop_is_that_of_its_pieces():
    n, turns = 32, 7
    a = jnp.ones((n, n))

    def program(a, turns=turns):
        return jax.lax.scan(lambda carry, _: (carry @ a, None), a, None, length=turns)[0]

    pieces = [Piece(lambda a: program(a, 1), (a,), turns)]
    work = bound.work_of(pieces)
    assert work.operations == pytest.approx(2 * n**3 * turns, rel=0.01)
    assert 3 * 4 * n**2 * turns == pytest.approx(work.bytes, rel=0.5)  # two in, one out
    row = measure.measure("products", "products", 1, turns, program, a, pieces=pieces)
    assert sane(row).bound.operations == pytest.approx(2 * n**3, rel=0.01)
    assert row.bound.arithmetic == pytest.approx(2 * n**3 * row.per_second / 1e11, rel=0.01)
    blind = measure.measure("products", "products", 1, turns, program, a)
    assert blind.bound.operations < 2 * row.bound.operations / turns  # the loop counts once


def test_a_look_up_moves_what_it_finds_and_not_the_table():
    lowered = jax.jit(lambda table, i: table[i]).lower(jnp.ones((10_000, 8)), jnp.arange(4))
    assert bound.counted(lowered, lowered.compile()).bytes < 10_000


@pytest.mark.parametrize(
    ("arithmetic", "memory", "limit"),
    [
        (0.1, 0.4, "neither"),
        (0.6, 0.4, "arithmetic"),
        (0.3, 0.6, "memory"),
        (0.3, 1.7, "caches"),
        (1.0, 3.0, "arithmetic"),
    ],
)
def test_limits_are_named(arithmetic, memory, limit):
    assert bound.named(arithmetic, memory) == limit
    found = bound.bound(Work(arithmetic * 1e11 * 2, memory * 1e10 * 2), count=4, per_second=2)
    assert found.limit == limit
    assert found.operations == pytest.approx(arithmetic * 1e11 / 2)


def test_this_machine_has_limits(monkeypatch):
    monkeypatch.undo()
    monkeypatch.setattr(bound, "COPIED", 2**16)
    monkeypatch.setattr(bound, "SIDE", 64)
    found = bound.limits.__wrapped__()
    assert 0 < found.bytes < float("inf")
    assert 0 < found.operations < float("inf")


BOUND = Bound(10.0, 20.0, 0.25, 0.5, "memory")
ROW = Row("what", "steps", 4, 2.0, 1.0, 3.0, 0.5, 100.0, 8.0, BOUND)


def test_a_row_in_another_unit():
    row = measure.recount(ROW, "samples", 4.0)
    assert (row.unit, row.per_second, row.slowest, row.fastest) == ("samples", 8.0, 4.0, 12.0)
    assert (row.bound.operations, row.bound.bytes) == (2.5, 5.0)
    assert (row.bound.arithmetic, row.bound.memory) == (0.25, 0.5)
    assert measure.recount(dataclasses.replace(ROW, bound=None), "samples", 4.0).bound is None


def test_the_median_of_several_processes_is_taken():
    first, middle, last = (
        dataclasses.replace(ROW, per_second=p, compile_seconds=c, peak_mib=m)
        for p, c, m in ((5.0, 1.0, 30.0), (7.0, 3.0, 10.0), (8.0, 2.0, 20.0))
    )
    found = measure.middle([last, first, middle])
    assert (found.slowest, found.per_second, found.fastest) == (5.0, 7.0, 8.0)
    assert (found.compile_seconds, found.peak_mib) == (2.0, 30.0)
    assert found.bound == ROW.bound
    assert measure.middle([first, last]).per_second == 5.0  # no rate that nothing had


def a_process():
    """A benchmark of one row, as many per second as its process has for a number."""
    return [dataclasses.replace(ROW, per_second=float(os.getpid()))]


def test_each_process_is_a_new_one():
    (row,) = measure.in_processes(a_process, 2)
    assert row.slowest < row.fastest
    assert os.getpid() not in (row.slowest, row.fastest)


def test_rows_are_compared_with_an_earlier_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    report.report("some", [ROW], tmp_path)
    faster = dataclasses.replace(ROW, per_second=5.0)
    new = dataclasses.replace(ROW, batch=8)
    for against in (tmp_path, tmp_path / "some.json"):
        before = compare.earlier(against, ["some", "other"])
        assert before == {("what", "steps", 4): 2.0}
        shown = [report._speed(row, True, before)["x earlier"] for row in (faster, new)]
        assert shown == ["2.50", "-"]
        monkeypatch.setattr("sys.argv", ["benchmarks.some", "--against", str(against), *HERE])
        capsys.readouterr()
        report.main("some", lambda: [faster, new])
        assert "earlier" in capsys.readouterr().out


GOOD = {"name": "what", "unit": "steps", "batch": 4, "per_second": 2.0}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "must hold one of some.json"),
        ("{", "cannot be read as JSON"),
        ("[]", "with a list of rows"),
        ('{"rows": 3}', "with a list of rows"),
        (json.dumps({"rows": [GOOD, "row"]}), "row 1: name is None; it must be text"),
        (json.dumps({"rows": [GOOD | {"batch": 1.5}]}), "batch is 1.5; it must be an integer"),
        (json.dumps({"rows": [GOOD | {"per_second": True}]}), "per_second is True"),
        (json.dumps({"rows": [GOOD | {"per_second": 0}]}), "it must be above 0"),
    ],
)
def test_a_bad_earlier_run_is_refused_before_anything_is_measured(
    text, message, tmp_path, monkeypatch, capsys
):
    if text is not None:
        (tmp_path / "some.json").write_text(text)
    with pytest.raises(ValueError, match=message):
        compare.earlier(tmp_path, ["some"])
    monkeypatch.setattr("sys.argv", ["benchmarks.some", "--against", str(tmp_path)])
    with pytest.raises(SystemExit) as stop:
        report.main("some", lambda: pytest.fail("nothing is to be run"))
    assert stop.value.code == 2
    assert message in " ".join(capsys.readouterr().err.split())


def test_no_process_at_all_is_refused(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["benchmarks.some", "--processes", "0"])
    with pytest.raises(SystemExit) as stop:
        report.main("some", lambda: pytest.fail("nothing is to be run"))
    assert stop.value.code == 2
    assert "processes is 0; it must be" in capsys.readouterr().err


def test_a_missing_earlier_run_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"none\.json; it cannot be read"):
        compare.earlier(tmp_path / "none.json", ["some"])


def test_rows_are_shown_and_written(tmp_path, capsys):
    report.report("some", [ROW, ROW], tmp_path / "new")
    shown = capsys.readouterr().out
    assert "some" in shown
    assert "what" in shown
    found = json.loads((tmp_path / "new" / "some.json").read_text())
    assert found["rows"] == [dataclasses.asdict(ROW)] * 2
    assert found["machine"]["jax"] == jax.__version__
    assert found["machine"]["cores"] >= 1


def test_each_benchmark_has_a_command_line_that_is_read_first(tmp_path, monkeypatch):
    out = tmp_path / "results"
    monkeypatch.setattr("sys.argv", ["benchmarks.some", "--out", str(out), *HERE])
    report.main("some", lambda: [ROW])
    assert [path.name for path in out.iterdir()] == ["some.json"]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["benchmarks.some", *HERE])
    report.main("some", lambda: [ROW])
    assert (tmp_path / "results" / "benchmarks" / "some.json").exists()
    monkeypatch.setattr("sys.argv", ["benchmarks.some", "--help"])
    with pytest.raises(SystemExit) as stop:
        report.main("some", lambda: pytest.fail("nothing is to be run"))
    assert stop.value.code == 0


def test_all_benchmarks_are_run_by_the_package(tmp_path, monkeypatch):
    for module in (env_step, recon, threat_query, train_step, seeds, tabular, adapters):
        monkeypatch.setattr(module, "run", lambda: [ROW])
    monkeypatch.setattr("sys.argv", ["benchmarks", "--out", str(tmp_path), *HERE])
    runpy.run_module("benchmarks", run_name="__main__")
    names = {"env_step", "recon", "threat_query", "train_step", "seeds", "tabular", "adapters"}
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


def tiny_tasks(names=("jam",)):
    """Tasks with networks and batches as small as they may be."""
    found = {}
    for name in names:
        module = EXPERIMENTS[name]
        config = module.quick("tuned")
        small = lambda threat: dataclasses.replace(  # noqa: E731
            threat, fit=dataclasses.replace(threat.fit, hidden=(4,), batch=16)
        )
        kinds = {kind: small(threat) for kind, threat in threats_of(config).items()}
        planning = dataclasses.replace(
            config.planning, num_envs=4, batch=8, replay=64, replay_start=8, n_step=1
        )
        config = dataclasses.replace(config, planning=planning, **kinds)
        found[name] = (module.make_world(config), config)
    return found


def test_the_setups_are_the_tuned_recipes():
    found = setups.quick_tasks()
    assert list(found) == list(EXPERIMENTS)
    for name, (world, config) in found.items():
        assert world.name == name
        assert config == EXPERIMENTS[name].quick("tuned")
        assert set(threats_of(config)) == set(world.env.sub_rmdps(world.params()))


def test_a_setup_has_a_model_of_each_kind_of_hazard():
    world, config = tiny_tasks()["jam"]
    pmdp = setups.pmdp_of(world, config)
    assert set(pmdp.threats) == {"obstacle", "wall"}
    assert pmdp.shielded
    assert 0 < float(pmdp.x) <= config.x


@pytest.mark.slow
def test_training_is_measured(monkeypatch):
    monkeypatch.setattr(train_step, "quick_tasks", tiny_tasks)
    monkeypatch.setattr(train_step, "ITERATIONS", 2)
    rows = [sane(row) for row in train_step.run()]
    assert [row.batch for row in rows] == [4, 4]
    assert [row.name.split(",")[0] for row in rows] == ["jam", "jam"]
    assert [row.unit for row in rows] == ["steps", "samples"]
    assert rows[1].per_second == pytest.approx(2 * rows[0].per_second)  # 8 to 4 steps


@pytest.mark.slow
def test_seeds_are_measured_side_by_side(monkeypatch):
    monkeypatch.setattr(seeds, "quick_tasks", tiny_tasks)
    monkeypatch.setattr(seeds, "ITERATIONS", 2)
    rows = [sane(row) for row in seeds.run((2,))]
    assert [(row.name, row.batch) for row in rows] == [("jam", 2)]


@pytest.mark.slow
def test_threat_queries_are_measured(monkeypatch):
    monkeypatch.setattr(threat_query, "quick_tasks", tiny_tasks)
    rows = [sane(row) for row in threat_query.run((1, 4))]
    assert [(row.name, row.batch, row.unit) for row in rows] == [
        (name, batch, unit) for name in ("jam",) for batch in (1, 4) for unit in ("states", "pairs")
    ]


RECONNAISSANCE = (
    "wall point, exact",
    "wall point, Monte Carlo",
    "obstacle, Monte Carlo",
    "obstacle, plans",
)


@pytest.mark.slow
def test_reconnaissance_is_measured(monkeypatch):
    found = recon.cases()
    assert set(found) == set(RECONNAISSANCE)
    few = {name: found[name] for name in ("wall point, exact", "wall point, Monte Carlo")}
    monkeypatch.setattr(recon, "cases", lambda: few)
    rows = [sane(row) for row in recon.run(32, (2,), states=64)]
    once, sampled = ["states", "states at 0.01"], ["states", "simulated steps", "states at 0.01"]
    assert [row.unit for row in rows if row.batch == 32] == once + sampled
    assert [row.unit for row in rows if row.batch == 2] == 2 * ["states"]
    first, equal = rows[:2]
    assert equal.per_second == first.per_second  # exact labels have no error
    assert rows[4].per_second == pytest.approx(64 * 15 * 5 * rows[3].per_second)


def test_an_error_asks_for_so_many_paths():
    sub, estimator = recon.cases()["obstacle, Monte Carlo"]
    few = recon.paths_needed(sub, estimator, 0.02, 32)
    assert recon.paths_needed(sub, estimator, 0.01, 32) == pytest.approx(4 * few)
    assert few > 0


@pytest.mark.slow
def test_environments_are_measured(monkeypatch):
    found = env_step.cases()
    assert len(found) == 6
    swept = {name: found[name] for name in env_step.SWEPT}
    monkeypatch.setattr(env_step, "cases", lambda: swept)
    rows = [sane(row) for row in env_step.run(4, (2,))]
    assert len({row.name for row in rows}) == 4
    assert [row.name for row in rows if row.batch == 2] == [
        "circuit, observed",
        "jam N=8, observed",
    ]


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
