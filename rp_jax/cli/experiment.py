"""The command line of a run: presets, any setting overridden, and interrupted runs resumed."""

import argparse
import dataclasses
import datetime
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import tyro

from rp_jax import devices, storage
from rp_jax.cli import errors, terminal
from rp_jax.runs import record, train
from rp_jax.runs.dataclass_json import restored
from rp_jax.runs.progress import OnProgress
from rp_jax.runs.saved import imported
from rp_jax.runs.train import Process, RunResult, TrainConfig, World
from rp_jax.threat.build import ThreatConfig
from rp_jax.validate import one_of

RECIPES = ("tuned", "paper")  # the first is the default


class Run(NamedTuple):
    """A run that is about to begin, or to go on."""

    world: World
    config: Any  # a TrainConfig
    threats: dict[str, ThreatConfig]  # settings by kind of hazard
    process: Process
    folder: Path


class Experiment(NamedTuple):
    """An experiment as its command line knows it."""

    name: str  # how it is called, for messages: "python -m experiments.jam"
    about: str  # what it does, for --help
    presets: Mapping[str, Callable[[str], TrainConfig]]  # by name, from a recipe's name
    make_world: Callable[[Any], World]  # from a configuration
    draw: Callable[[RunResult, OnProgress], None] | None = None  # the world's own figures
    job: Callable[[Run, OnProgress], None] | None = None  # in place of training and evaluating
    recipes: Sequence[str] = RECIPES


def default_out(name: str) -> Path:
    """Returns results/NAME-TIME, the time to the microsecond.

    Args:
        name: of what is run.
    """
    now = datetime.datetime.now().strftime("%Y%m%d-%H%M%S-%f")
    return Path("results") / f"{name}-{now}"


def threats_of(config: Any) -> dict[str, ThreatConfig]:
    """Returns the settings of threat functions that a configuration has, by kind of hazard.

    Args:
        config: a dataclass, whose fields of that type are called as the kinds are.
    """
    found = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
    return {name: value for name, value in found.items() if isinstance(value, ThreatConfig)}


def run(experiment: Experiment, argv: Sequence[str]) -> Path:
    """Runs an experiment from the command line; exits with 2 on bad input.

    Args:
        experiment: what is run.
        argv: arguments.

    Returns:
        The folder of the results.
    """
    argv, folder = list(argv), to_resume(argv)
    with errors.bad_input():
        begun = resumed(experiment, folder, argv) if folder else _begun(experiment, argv)
    again = f"{experiment.name} --resume {begun.folder}"
    finish = lambda: shutil.rmtree(begun.folder / record.CHECKPOINTS)  # noqa: E731
    with errors.resumable(again, begun.folder, finish), terminal.progress() as bar:
        (experiment.job or _whole(experiment))(begun, bar)
    terminal.say(f"results: {begun.folder}")
    return begun.folder


def _begun(experiment: Experiment, argv: list[str]) -> Run:
    """A new run, checked, with its folder."""
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--preset", default=next(iter(experiment.presets)))
    first.add_argument("--recipe", default=experiment.recipes[0])
    chosen, rest = first.parse_known_args(argv)
    preset = experiment.presets[one_of("preset", chosen.preset, experiment.presets)]
    default = preset(one_of("recipe", chosen.recipe, experiment.recipes))
    config, process = parsed(default, rest, experiment.name, _description(experiment))
    world, threats = experiment.make_world(config), threats_of(config)
    train.checked(world, config, threats, process)
    errors.needs_matplotlib(process.figures)
    errors.without_figures(process.figures)
    if devices.is_first():
        name = f"{world.name}-{chosen.preset}"
        folder = storage.new_folder(process.out or default_out(name))
    else:  # what the others write is thrown away
        folder = Path(tempfile.mkdtemp())
    facts = {"experiment": experiment.name, "preset": chosen.preset}
    keep = lambda: train.keep_threat(world, process.threat, folder)  # noqa: E731
    begin(folder, facts | train.facts(world, config, threats, process), keep)
    return Run(world, config, threats, process, folder)


def parsed(default: TrainConfig, argv: Sequence[str], name: str, about: str) -> tuple[Any, Process]:
    """Reads the options of a run.

    Args:
        default: its configuration, from which the options follow.
        argv: arguments.
        name: of the program.
        about: what it does.
    """
    flat = tyro.conf.arg(name="")
    kind = dataclasses.make_dataclass(
        "Options",
        [
            ("config", Annotated[type(default), flat], dataclasses.field(default=default)),
            ("process", Annotated[Process, flat], dataclasses.field(default=Process())),
        ],
    )
    found: Any = tyro.cli(kind, args=list(argv), prog=name, description=about)
    return found.config, found.process


def begin(folder: Path, facts: Mapping[str, Any], keep: Callable[[], None] = lambda: None) -> None:
    """Makes the place for the checkpoints of a new run, and writes its config.json last.

    Args:
        folder: of the run.
        facts: what the run depends on.
        keep: copies what else it depends on into the folder.

    Raises:
        storage.StorageError: another process has just begun one there.
    """
    try:
        (folder / record.CHECKPOINTS).mkdir()
    except FileExistsError:
        raise storage.StorageError(f"out is {folder}; another run has begun there") from None
    keep()
    storage.write_json(folder / "config.json", facts)


def to_resume(argv: Sequence[str]) -> Path | None:
    """Returns DIR of --resume DIR, if that is given.

    Args:
        argv: arguments.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--resume", type=Path)
    return parser.parse_known_args(list(argv))[0].resume


def interrupted(folder: Path, name: str, env: Any, argv: Sequence[str]) -> dict[str, Any]:
    """Returns config.json of an interrupted run that can be gone on with here.

    Args:
        folder: of the run.
        name: of the program that goes on.
        env: the environment; None: what is compared is the library alone.
        argv: all arguments: there may be no others.

    Raises:
        ValueError: there are other arguments; or it is no run, it is finished, or was begun by
            something else or elsewhere.
    """
    if len(argv) > (2 if "--resume" in argv else 1):  # --resume DIR, --resume=DIR
        raise ValueError(
            f"resume is {folder}; no other option may be given with it: the settings are those in "
            "its config.json"
        )
    plain = record.read_json(folder / "config.json")
    if not (folder / record.CHECKPOINTS).is_dir():
        raise ValueError(
            f"resume is {folder}; it must be an interrupted run, but there are no checkpoints: "
            "it is finished"
        )
    wanted = record.plain({"experiment": name, **record.machine(env)})
    of_library = {key: _part(plain.get(key), value) for key, value in wanted.items()}
    record.compared(f"resume is {folder}", plain if env is not None else of_library, wanted)
    return plain


def _part(found: Any, wanted: Any) -> Any:
    """Returns what was kept, of a table only the entries that are wanted."""
    if isinstance(found, dict) and isinstance(wanted, dict):
        return {name: value for name, value in found.items() if name in wanted}
    return found


def resumed(experiment: Experiment, folder: Path, argv: Sequence[str]) -> Run:
    """Returns an interrupted run to go on with, checked.

    Args:
        experiment: that began it.
        folder: of the run.
        argv: all arguments.

    Raises:
        ValueError: the run cannot be resumed here.
    """
    path = folder / "config.json"
    plain = record.read_json(path)
    facts = plain.get("world")
    if not isinstance(facts, dict):
        raise storage.StorageError(f"{path}: world is {facts!r}; it must be a table")
    default = experiment.presets[next(iter(experiment.presets))](experiment.recipes[0])
    config = restored(type(default), plain.get("config"), f"{path}: config")
    process = restored(Process, plain.get("process"), f"{path}: process")
    process = train.with_own_threat(process, folder)
    if process.devices == "cluster":
        raise ValueError(f"resume is {folder}; its devices is 'cluster'; it must be 'one' or 'all'")
    world = experiment.make_world(config)
    interrupted(folder, experiment.name, world.env, argv)
    made = record.plain(train.facts(world, config, {}, process)["world"])
    record.compared(f"resume is {folder}", facts, made)
    threats = threats_of(config)
    train.checked(world, config, threats, process)
    return Run(world, config, threats, process, folder)


def world_of(folder: Path, env: Any = None) -> World:
    """Returns the world of a run, from its config.json.

    Args:
        folder: of the run.
        env: the environment; imported by its name if it is not given.

    Raises:
        storage.StorageError: there is no such file, or it is not of a run.
    """
    path = folder / "config.json"
    facts = record.read_json(path).get("world")
    if not isinstance(facts, dict):
        raise storage.StorageError(f"{path}: world is {facts!r}; it must be a table")
    found = imported(facts.get("env")) if env is None else env
    return World(
        str(facts.get("name")), found, dict(facts.get("settings", {})), dict(facts.get("tests", {}))
    )


def _whole(experiment: Experiment) -> Callable[[Run, OnProgress], None]:
    """Training and evaluation, then tables and figures."""

    def job(run: Run, bar: OnProgress) -> None:
        result = train.train(
            run.world,
            run.config,
            run.threats,
            run.folder,
            run.process,
            on_progress=bar,
            say=terminal.say,
        )
        from rp_jax.cli import results

        results.show(result)
        if run.process.figures:
            (run.folder / "figures").mkdir(exist_ok=True)
            results.draw(result)
            if experiment.draw is not None:
                experiment.draw(result, bar)

    return job


def _description(experiment: Experiment) -> str:
    presets, recipes = experiment.presets, experiment.recipes
    resume = "--resume DIR, alone, goes on with an interrupted run."
    if len(presets) == 1 and len(recipes) == 1:
        return f"{experiment.about}\n\n{resume}"
    return (
        f"{experiment.about}\n\n--preset {{{','.join(presets)}}} (default {next(iter(presets))}) "
        f"and --recipe {{{','.join(recipes)}}} (default {recipes[0]}) choose the values below; any "
        f"of them can be overridden. {resume}"
    )
