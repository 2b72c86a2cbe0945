"""Run folders that hold what results read, made up."""

import numpy as np
from PIL import Image

from experiments.figures.words import counted
from experiments.paper.commands import COMMANDS
from rp_jax import storage
from rp_jax.evaluation import Episodes, summarise

VARIANTS = {
    "circuit": ("default", "narrowed", "circle"),
    "jam": ("N=3", "N=8", "N=15", "N=30", "N=50"),
    "point_gather": ("8 bombs", "16 bombs"),
}
PENALTIES = {"circuit": (0, 20, 200), "jam": (5, 50, 500), "point_gather": (1, 10, 50)}
RP = {"circuit": "RP (x=0.001)", "jam": "RP (x=0.01)", "point_gather": "RP (x=0.5)"}


def evaluated(variant, method, seed, rate, score=50.0, episodes=400):
    """A row of a table: episodes of a given return, some of which crash."""
    n = np.arange(episodes)
    zeros, none = np.zeros(episodes, int), np.zeros(episodes, bool)
    crashed = n < rate * episodes
    rows = Episodes(
        score=score + (n % 7) + seed - 20 * crashed,
        danger=crashed.astype(float),
        goal=none,
        length=zeros + 10,
        interventions=zeros,
        insecure=zeros,
        booked=zeros * 0.0,
        collisions={"wall": crashed},
        bad_observations=zeros,
        bad_threats=zeros,
    )
    about = {"env": "?", "variant": variant, "method": method, "seed": seed, "x": 0.01}
    times = {"seconds_per_100_actions": 0.1, "train_seconds": 1.0}
    return {**about, **summarise(rows, 50.0), **times}


def learned(method, seeds, rate):
    """Rows of metrics.jsonl; no episode ends in the first chunk."""
    return [
        {
            "seed": seed,
            "method": method,
            "steps": 100 * (i + 1),
            "episodes": 20 * (i > 0),
            "return_mean": i + seed if i > 0 else None,
            "crashes": int(20 * rate) * (i > 0),
            "inadmissible": 0,
            "seconds": 10.0 * i,
        }
        for i in range(4)
        for seed in range(seeds)
    ]


def write_lines(path, rows):
    path.parent.mkdir(parents=True, exist_ok=True)
    storage.write_bytes(path, "".join(storage.json.dumps(row) + "\n" for row in rows).encode())


def picture(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (8, 8), "red").save(path)


class Stub:
    """Stands for `paper.sources.Sources`: makes each folder when it is asked for."""

    def __init__(self, folder, seeds=2):
        self.folder, self.seeds = folder, seeds

    def __call__(self, name):
        assert name in COMMANDS
        folder = self.folder / name
        if not folder.exists():
            folder.mkdir(parents=True)
            module, *words = COMMANDS[name].split()
            env = next((env for env in VARIANTS if env in words), module)
            {"compare": self.compare, "frontier": self.frontier, "theorems": self.theorems}.get(
                module, self.run
            )(folder, env)
        return folder

    def run(self, folder, env):
        """Of a task, MPC included: tables, curves, pictures."""
        env = "jam" if env == "patrol" else env
        method = RP[env].replace("0.5", "0.1") if folder.name.endswith("x01") else RP[env]
        steps = counted(int(folder.name[-1]), "step") if folder.name.startswith("mpc") else ""
        method = f"MPC ({steps})" if steps else method
        found = [
            evaluated(variant, method, seed, 0.01 * i)
            for i, variant in enumerate(VARIANTS[env])
            for seed in range(self.seeds)
        ]
        history = learned(method, self.seeds, 0.1)
        if folder.name == "patrol":
            for other in ("DQN (penalty 0)", "DQN (penalty 50)"):
                found += [evaluated(v, other, 0, 0.5, score=10.0) for v in VARIANTS[env]]
                history += learned(other, self.seeds, 0.6)
        storage.write_json(folder / "table.json", found)
        write_lines(folder / "metrics.jsonl", history)
        parts = {"reconnaissance": 120.0, "planning_compilation": 30.0, "planning": 180.0}
        storage.write_json(folder / "training.json", {"steps": 400, "seconds": parts})
        picture(folder / "animation.gif")
        for figure in ("threat_of_one_obstacle", "threat_of_all", "trajectories"):
            picture(folder / "figures" / f"{figure}.png")
        (folder / "threat").mkdir()
        report = {"mae": 0.01, "bias": -0.001, "unsafe_called_safe": 0.02}
        rows = [{"hazard": "wall", "of": of, **report} for of in ("one", "sum")]
        storage.write_json(folder / "threat" / "report.json", rows)

    def compare(self, folder, env):
        learner = folder.name.removeprefix("long_").partition("_")[0]
        methods = {
            "dqn": [f"DQN (penalty {p})" for p in PENALTIES[env]],
            "cpo": ["CPO"],
            "pid": ["PID-Lagrangian"],
        }[learner]
        steps = 1000 if folder.name.startswith("long") else 100
        history = [row for m in methods for row in learned(m, self.seeds, 0.5)]
        write_lines(folder / learner / "metrics.jsonl", history)
        found = [
            {**evaluated(variant, method, seed, 0.4, score=30.0), "training_steps": steps}
            for variant in VARIANTS[env][:3]
            for method in methods
            for seed in range(self.seeds)
        ]
        storage.write_json(folder / "compare.json", found)

    def frontier(self, folder, env):
        found = [
            {**evaluated(variant, "RP", 0, x), "planner": planner, "x": x, "seeds": 2}
            | {"insecure": 0.1 - x}
            for planner in ("separate", "told x")
            for variant in ("N=3", "N=8")
            for x in (0.001, 0.01)
        ]
        storage.write_json(folder / "frontier.json", found)

    def theorems(self, folder, env):
        rows = [
            {"theorem": "theorem 1", "horizon": h, "instances": 10, "violations": 0, "largest": -h}
            for h in (1, 2)
        ]
        storage.write_json(folder / "table.json", rows)
