"""Command lines of all runs that results are taken from, in two sizes.

A word that begins with @ is a file of another run, which is made first.
"""

_AHEAD = (
    "{jam_steps} --baseline plans --x 0.002 --lookahead 8 --insecure-penalty 1"
    " --learning-penalty 50 --fewest-obstacles 0 --threat @jam_plans/threat --no-figures"
)
COMMANDS: dict[str, str] = {
    "frozen_lake": "frozen_lake --no-figures {frozen_lake}",
    "theorems": "theorems --instances {instances}",
    # RP, with the tuned recipe and the paper's baseline policy, and under plans.
    "circuit": "circuit {seeds} {circuit_steps} {wall}",
    "circuit_lost": "circuit {seeds} {circuit_steps} {wall} --hide-position 0.1",
    "jam": "jam {seeds} {jam_steps} {wall} {obstacle} --test-obstacles 3 8 15 30 50",
    "point_gather": "point_gather {seeds} {gather_steps} {bomb}",
    "point_gather_x01": "point_gather {seeds} {gather_steps} --x 0.1 --threat @point_gather/threat"
    " --no-figures",
    "circuit_plans": "circuit {seeds} {circuit_steps} --baseline plans --hide-position 0.1",
    "jam_plans": "jam {seeds} {jam_steps} {obstacle} --baseline plans --x 0.001"
    " --insecure-penalty 1 --learning-penalty 50 --test-obstacles 3 8 15 30 50",
    "jam_ahead": f"jam {{seeds}} {_AHEAD} --test-obstacles 3 8 15",
    "jam_ahead_crowds": f"jam {{few}} {_AHEAD} --test-obstacles 30 50",  # slow
    # As many steps as the paper's returns need (benchmarks.to_return).
    "circuit_brief": "circuit {brief} {circuit_brief} --baseline plans --hide-position 0.1"
    " --no-figures",
    "jam_brief": "jam {brief} {jam_brief} {wall} {obstacle} --no-figures",
    # The paper's networks and settings, its threat functions included.
    "circuit_paper": "circuit --recipe paper {episodes} {paper_steps} {paper_wall}",
    "jam_paper": "jam --recipe paper {episodes} {paper_steps} {paper_wall} {paper_obstacle}",
    # What RP is compared with.
    **{
        f"{more}{method.lower()}_{env}": f"compare --env {env} --methods {method} "
        + f"{{{more or 'as_'}{env}}}"
        for more in ("", "long_")
        for env in ("circuit", "jam", "point_gather")
        for method in ("DQN", "CPO", "PID")
    },
    "mpc_circuit_3": "mpc --env circuit --horizon 3 {mpc}",
    "mpc_circuit_4": "mpc --env circuit --horizon 4 {mpc}",
    "mpc_circuit_5": "mpc --env circuit --horizon 5 --variants default {mpc_few}",
    "mpc_jam_2": "mpc --env jam --horizon 2 {mpc}",
    "mpc_jam_3": "mpc --env jam --horizon 3 {mpc}",
    "mpc_point_gather_1": "mpc --env point_gather --horizon 1 {mpc}",
    "mpc_point_gather_2": "mpc --env point_gather --horizon 2 {mpc}",
    # Beyond the paper.
    "frontier": "frontier {few} {jam_steps} --threat @jam_plans/threat",
    "patrol": "patrol {few} {jam_steps} --threat @jam/threat",
    # One switch each, against `jam`.
    "unmasked": "jam {few} {jam_steps} --threat @jam/threat --planning.learner.no-masked-target"
    " --no-figures",
    "plans": "jam {few} {jam_steps} {obstacle} --baseline plans --no-figures",
    "sampled_walls": "jam {few} {jam_steps} {wall} {obstacle} --wall.no-exact --no-figures",
    "few_states": "jam {few} {jam_steps} {wall} {obstacle} {few_states} --no-figures",
    "uniform": "jam {few} {jam_steps} {wall} {obstacle} --obstacle.sampling uniform --no-figures",
    "horizon_5": "jam {few} {jam_steps} {wall} {obstacle} --obstacle-horizon 5 --no-figures",
    "horizon_12": "jam {few} {jam_steps} {wall} {obstacle} --obstacle-horizon 12 --no-figures",
}

_FIT = "--{0}.fit.steps 2000 --{0}.test-states 500 --{0}.test-paths 1024"
_SMALL = "--planning.num-envs 32 --planning.batch 128"  # batches: more is learned from a step
_FEW, _MORE = (f"--steps {steps} --episodes 1000" for steps in (200_000, 600_000))
SIZES: dict[str, dict[str, str]] = {
    "full": {
        "frozen_lake": "",
        "instances": "200000",
        "seeds": "--preset full --episodes 10000",
        "brief": f"--preset full --episodes 2000 {_SMALL}",
        "few": "--preset full --seeds 3 --episodes 4000",
        "episodes": "--preset full --episodes 10000",
        "circuit_steps": "",
        "jam_steps": "",
        "circuit_brief": "--planning.steps 300000",
        "jam_brief": "--planning.steps 100000",
        "gather_steps": "",
        "paper_steps": "",
        "wall": "",
        "obstacle": "",
        "bomb": "",
        "paper_wall": "",
        "paper_obstacle": "",
        "few_states": "--obstacle.states 20000 --obstacle.paths 640",
        "as_circuit": "--seeds 10 --steps 1800000 --episodes 2000",
        "as_jam": "--seeds 10 --steps 1200000 --episodes 2000",
        "as_point_gather": "--seeds 10 --steps 1200000 --episodes 2000",
        "long_circuit": "--steps 18000000 --episodes 2000",
        "long_jam": "--steps 12000000 --episodes 2000",
        "long_point_gather": "--steps 12000000 --episodes 2000",
        "mpc": "--episodes 1000",
        "mpc_few": "--episodes 200",
    },
    "quick": {
        "frozen_lake": "--horizons 100 --no-program",
        "instances": "2000",
        "seeds": "--episodes 1000",
        "brief": f"--episodes 1000 {_SMALL}",
        "few": "--episodes 1000",
        "episodes": "--episodes 1000",
        "circuit_steps": "--planning.steps 200000",
        "jam_steps": "--planning.steps 200000",
        "circuit_brief": "--planning.steps 100000",
        "jam_brief": "--planning.steps 50000",
        "gather_steps": "--planning.steps 200000",
        "paper_steps": "--planning.steps 20000",
        "wall": "--wall.states 20000 " + _FIT.format("wall"),
        "obstacle": "--obstacle.states 20000 " + _FIT.format("obstacle"),
        "bomb": "--bomb.states 20000 " + _FIT.format("bomb"),
        "paper_wall": "--wall.states 20000 " + _FIT.format("wall"),
        "paper_obstacle": "--obstacle.states 5000 " + _FIT.format("obstacle"),
        "few_states": "--obstacle.states 2000 --obstacle.paths 640",
        **dict.fromkeys(("as_circuit", "as_jam", "as_point_gather"), _FEW),
        **dict.fromkeys(("long_circuit", "long_jam", "long_point_gather"), _MORE),
        "mpc": "--episodes 50",
        "mpc_few": "--episodes 5",
    },
}


def words(name: str, preset: str) -> list[str]:
    """The command line of a run, without the folder for its results."""
    return COMMANDS[name].format(**SIZES[preset]).split()
