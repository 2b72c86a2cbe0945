"""Results of the paper from run folders that are made up: numbers, figures, verdicts."""

import dataclasses
import importlib
import itertools
import json

import numpy as np
import pytest
import tyro
from stubs import RP, Stub, evaluated
from tiny import programs_of_a_moment  # noqa: F401

from experiments import all as everything
from experiments import compare
from experiments.paper import (
    ablations,
    brief,
    commands,
    fig5,
    published,
    scores,
    section,
    table1,
    tables3_4,
    thresholds,
    walls,
)
from experiments.paper import training_crashes as crashes
from experiments.tasks import EXPERIMENTS
from rp_jax import storage
from rp_jax.cli import experiment
from rp_jax.evaluation import Episodes, summarise

PLAIN = [
    name for name in everything.RESULTS if name not in ("fig2", "fig3", "fig6", "timing", "walls")
]


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    return Stub(tmp_path_factory.mktemp("runs"))


def made(name, sources, folder):
    """The results as they are read back from JSON."""
    folder.mkdir(exist_ok=True)
    storage.write_json(folder / "results.json", everything.RESULTS[name].run(sources, folder))
    return json.loads((folder / "results.json").read_text())


@pytest.mark.parametrize("name", PLAIN)
def test_each_result_has_what_its_section_speaks_of(name, sources, tmp_path):
    module = everything.RESULTS[name]
    results = made(name, sources, tmp_path / name)
    if hasattr(module, "plot"):
        module.plot(results, tmp_path / name)
    told = module.tell(results)
    assert told.tables
    for table in told.tables:
        assert len({tuple(row) for row in table.rows}) == 1  # the same columns
    pictures = {p.name for p in (tmp_path / name).iterdir()} - {"results.json"}
    assert pictures == set(told.figures)
    for claim in told.claims:
        assert claim.verdict.partition(" (")[0] in (
            *(section.EXCEEDED, section.REPRODUCED, section.MISSED),
        )


def test_a_table_has_all_methods_beside_the_published_ones(sources, tmp_path):
    told = table1.tell(made("table1", sources, tmp_path / "table1"))
    rows = {(row["variant"], row["method"]): row for row in told.tables[0].rows}
    assert len(rows) == 3 * 9  # RP three times, three DQN, CPO, PID, MPC
    assert rows["N=8", "RP"]["paper: return (crashes)"] == "69.1 (0 %)"
    assert rows["N=15", "MPC (3 steps)"]["paper: return (crashes)"] == "36.6 (45 %)"
    assert rows["N=8", "CPO"]["paper: return (crashes)"] == ""
    assert rows["N=8", "RP"]["crashes"] == "8 of 800"


def test_crashes_while_learning_are_those_of_all_chunks_and_seeds(sources, tmp_path):
    rows = made("training_crashes", sources, tmp_path / "training_crashes")
    found = {(row["env"], row["method"]): row for row in rows}
    assert set(found) == {
        *((env, method) for env in RP for method in ("RP", "CPO", "PID-Lagrangian")),
        *((env, "RP, plans") for env in ("circuit", "jam")),
        ("circuit", "RP, lost"),
        ("jam", "RP, plans, one step ahead"),
        ("point_gather", "RP, x = .1"),
        *(("circuit", f"DQN (penalty {p})") for p in (0, 20, 200)),
        *(("jam", f"DQN (penalty {p})") for p in (5, 50, 500)),
        *(("point_gather", f"DQN (penalty {p})") for p in (1, 10, 50)),
    }
    assert (found["jam", "RP"]["crashes"], found["jam", "RP"]["episodes"]) == (2 * 3 * 2, 120)
    assert found["jam", "RP"]["danger"] == pytest.approx(0.1)
    for claim in crashes.tell(rows).claims:  # one in ten, which is c on Point Gather alone
        gather = "point_gather" in claim.claim
        assert claim.verdict == (section.REPRODUCED if gather else section.MISSED)
    (bombs,) = (row for row in rows if (row["env"], row["method"]) == ("point_gather", "RP"))
    assert crashes._keeps({**bombs, "danger": 0.1})  # c is of bombs, however many episodes
    assert not crashes._keeps({**bombs, "crash_rate": 0.05, "danger": 0.11})


def test_how_long_ten_agents_take_is_held_against_the_goal(sources, tmp_path):
    results = made("brief", sources, tmp_path / "brief")
    told = brief.tell(results)
    assert "within 8 minutes; together 11.0 minutes, 3.0 more than wanted." in told.text
    assert [row["seeds"] for row in told.tables[-1].rows] == [2, 2]
    assert {row["variant"] for row in told.tables[1].rows} == {"N=3", "N=8", "N=15"}
    results["jam"]["seconds"]["planning"] = 0.0
    assert "together 8.0 minutes. " in brief.tell(results).text
    resumed = {**results, "jam": {**results["jam"], "resumed": True}}
    assert "a run was resumed" in brief.tell(resumed).text


def test_the_curves_claims_look_at_every_chunk(sources, tmp_path):
    results = made("fig5", sources, tmp_path / "fig5")
    claims = {claim.claim: claim for claim in fig5.tell(results).claims}
    lowest = "Figure 5, jam: the lowest crash rate, in almost all phases"
    highest = "Figure 5, jam: the highest return in almost all phases of training"
    for claim in (lowest, highest):  # MPC crashes less and earns more, from the first chunk on
        assert (claims[claim].ours, claims[claim].verdict) == ("0 % of 3 points", section.MISSED)
    weak = {**results["jam"], "levels": [evaluated("N=8", "MPC (3 steps)", 0, 0.5, score=-60.0)]}
    level = {claim.claim: claim for claim in fig5.tell({**results, "jam": weak}).claims}
    for claim in (lowest, highest):
        assert level[claim].ours == "100 % of 3 points"
        assert level[claim].verdict == section.REPRODUCED
    safer = claims["Section 5.3, jam: safer than 3-step MPC"]
    assert safer.verdict == section.MISSED  # level


def test_the_ablations_say_what_was_hit_with_each_switch(sources, tmp_path):
    results = made("ablations", sources, tmp_path / "ablations")
    rows = ablations.tell(results).tables[0].rows
    found = {(row["method"], row["variant"]): row["what was hit"] for row in rows}
    assert found["as in table 1", "N=3"] == ""
    assert found["obstacles: horizon 5", "N=8"] == "wall 8"
    old = [{**row, "causes": {"wall": 1, "obstacle": 2}} for row in results]
    for row in old:
        del row["collisions"]
    assert ablations.tell(old).tables[0].rows[0]["what was hit"] == "wall 2, obstacle 4"


def test_figure_5_is_told_in_plain_words(sources, tmp_path, monkeypatch):
    from rp_jax.plot import curves

    drawn = []
    monkeypatch.setattr(curves, "methods", lambda *given: drawn.append(given))
    results = made("fig5", sources, tmp_path / "fig5")
    fig5.plot(results, tmp_path / "fig5")
    ((panels, _, levels),) = drawn
    assert list(panels) == ["Point Gather", "Circuit", "Jam"]
    shown = [row["method"] for row in levels["Point Gather"]]
    assert list(dict.fromkeys(shown)) == ["MPC (1 step)", "MPC (2 steps)"]
    told = fig5.tell(results)
    assert told.text.startswith("2 seeds; ")
    assert not any("1 steps" in row["method"] for row in told.tables[0].rows)


def test_wider_is_said_only_where_the_ranks_say_it():
    def verdicts(shares):
        rows = [evaluated("N=8", "RP", seed, 0.0, 1.0) for seed in range(len(shares))]
        rows = [
            {**row, "planner": "separate", "x": 10.0**-i, "insecure": share, "seeds": 3}
            for i, (row, share) in enumerate(zip(rows, shares, strict=True))
        ]
        (claim,) = thresholds.tell(rows).claims
        return claim.verdict

    assert verdicts([0.01, 0.02, 0.03, 0.04, 0.05]) == section.REPRODUCED
    assert verdicts([0.05, 0.07, 0.03, 0.04, 0.06]) == section.MISSED
    assert verdicts([0.05, 0.04, 0.03, 0.02, 0.01]) == section.MISSED


def test_whether_returns_still_rise_is_said_of_the_last_tenth_of_the_steps():
    chunks = range(1, 21)
    history = [
        {"method": "A", "seed": seed, "steps": 100 * i, "episodes": i, "return_mean": i + seed}
        for seed in (0, 1)
        for i in chunks
    ]
    (line,) = fig5.rise("jam", {"history": history})
    late = (19 * 19 + 20 * 20) / 39
    assert line["last tenth"] == f"{late + 0.5:.2f}"
    before = (17 * 17 + 18 * 18) / 35
    assert line["change from the tenth before"] == f"{late - before:+.2f} +- 0.00"
    assert line["steps"] == "2,000"
    (line,) = fig5.rise("jam", {"history": [row for row in history if row["seed"] == 0]})
    assert line["change from the tenth before"] == f"{late - before:+.2f}"  # one seed: no interval


@pytest.mark.parametrize("rate", [0.0, 0.02, 0.5, 1.0])
def test_another_penalty_gives_what_it_would_have_given_at_once(rate):
    row = evaluated("a", "b", 0, rate)
    n = np.arange(400)
    crashed = n < rate * 400
    zeros = np.zeros(400, int)
    rows = Episodes(
        50.0 + (n % 7) - 20 * crashed,
        crashed.astype(float),
        zeros > 0,
        zeros + 10,
        zeros,
        zeros,
        zeros * 0.0,
        {"wall": crashed},
        zeros,
        zeros,
    )
    expected, found = summarise(rows, 500.0), scores.repenalised(row, 450.0)
    for name in ("return_mean", "return_ci95", "crash_rate"):
        assert found[name] == pytest.approx(expected[name], rel=1e-6)


def test_the_heavier_tables_of_the_paper_follow_from_the_lighter_ones():
    for env, (_, penalty) in tables3_4.TABLES.items():
        more = published.HEAVIER[env] - penalty
        for variant, methods in published.SCORES[env].items():
            for method, (earned, rate) in methods.items():
                heavy = published.HEAVIER_SCORES[env][variant][method]
                assert heavy == (pytest.approx(earned - more * rate, abs=0.6), rate)


@pytest.mark.parametrize(
    ("mean", "width", "interval", "wanted", "verdict"),
    [
        (80, 1, (0, 0.004), (69.1, 0.0), "exceeded (return)"),
        (69, 1, (0, 0.004), (69.1, 0.0), "reproduced"),
        (69, 1, (0, 0.006), (69.1, 0.0), "not reproduced (crashes)"),
        (60, 1, (0, 0.006), (69.1, 0.0), "not reproduced (return and crashes)"),
        (33, 1, (0.01, 0.014), (33.0, 0.02), "exceeded (crashes)"),
        (33, 1, (0.01, 0.016), (33.0, 0.02), "reproduced"),
        (80, 1, (0.03, 0.04), (33.0, 0.02), "not reproduced (crashes)"),
    ],
)
def test_verdicts_go_by_whole_intervals(mean, width, interval, wanted, verdict):
    row = {"return_mean": mean, "return_ci95": width, "crash_ci95": interval, "seeds": 10}
    assert section.verdict_on(row, wanted) == verdict
    alone = section.verdict_on(row | {"seeds": 1}, wanted)
    assert alone == verdict if "not" in verdict else alone == section.REPRODUCED


def test_a_wide_interval_alone_reproduces_nothing():
    row = {"return_mean": 60, "return_ci95": 20, "crash_ci95": (0, 0.001), "seeds": 10}
    assert section.verdict_on(row, (69.1, 0.0)) == "not reproduced (return)"
    assert section.verdict_on(row | {"return_mean": 67.8}, (69.1, 0.0)) == section.REPRODUCED


def test_goals_are_met_or_missed_by_so_much():
    rows = scores.summed_up(scores.named([evaluated("N=8", "", 0, 0.0, 80.0, 10_000)], "RP"))
    (line,) = scores.goals(rows, "jam").rows
    assert line["met"] == "yes"
    rows[0] |= {"return_mean": 60.0, "crash_upper95": 0.003}
    (line,) = scores.goals(rows, "jam").rows
    assert line["met"] == "missed: return by 9.10, crash bound by 0.100 %"


def parsed(name, preset):
    """The configuration of a run, checked as its experiment does it."""
    module_name, *rest = commands.words(name, preset)
    module = importlib.import_module(f"experiments.{module_name}")
    if not hasattr(module, "EXPERIMENT"):
        config = tyro.cli(module.Config, args=rest)
        if module_name == "compare":
            compare.settings_of(config)
        elif module_name == "mpc":
            assert config.env in EXPERIMENTS
        else:
            config.validate()
        return config
    given = dict(itertools.pairwise(rest))
    own = module.EXPERIMENT
    base = own.presets[given.get("--preset", "quick")](given.get("--recipe", "tuned"))
    for word in ("--preset", "--recipe"):
        if word in rest:
            at = rest.index(word)
            del rest[at : at + 2]
    config, _ = experiment.parsed(base, rest, own.name, own.about)
    config.validate()
    assert own.make_world(config).tests
    return config


@pytest.mark.parametrize("preset", commands.SIZES)
@pytest.mark.parametrize("name", commands.COMMANDS)
def test_commands_are_understood(name, preset):
    config = parsed(name, preset)
    for word in commands.words(name, preset):
        if word.startswith("@"):
            assert word[1:].partition("/")[0] in commands.COMMANDS
    if preset == "full" and name in ("jam", "circuit", "circuit_lost", "point_gather", "jam_plans"):
        assert (config.seeds, config.episodes) == (10, 10_000)
    if preset == "full" and name.startswith(("dqn", "cpo", "pid")):
        of = parsed(config.env, preset)
        assert (config.seeds, config.steps) == (10, of.planning.steps)  # as many as RP has
        assert parsed(f"long_{name}", preset).steps == 10 * config.steps


def test_one_switch_differs_from_the_first_table():
    reference = dataclasses.asdict(parsed("jam", "full"))
    for name, switched in {
        "unmasked": {"planning"},
        "plans": {"baseline"},
        "sampled_walls": {"wall"},
        "few_states": {"obstacle"},
        "uniform": {"obstacle"},
        "horizon_5": {"obstacle_horizon"},
        "horizon_12": {"obstacle_horizon"},
    }.items():
        changed = dataclasses.asdict(parsed(name, "full"))
        found = {key for key, value in changed.items() if value != reference[key]}
        assert found - {"seeds", "episodes", "test_obstacles"} == switched


def test_sums_over_walls_are_compared_with_the_joint_threat():
    joint = np.asarray([[0.0, 0.0005, 0.005, 1.0]])
    found = walls.compared(np.asarray([[0.0, 0.002, 0.01, 1.5]]), joint, 0.001)
    assert found["admissible"] == 0.25
    assert found["secure"] == 1.0
    assert found["below_joint"] == 0.0
    assert found["ratios"] == [pytest.approx(4.0), pytest.approx(2.0), None, pytest.approx(1.5)]
