"""A finished run on the terminal, and the figures that every world has."""

from collections.abc import Mapping, Sequence
from typing import Any

from rp_jax.cli import terminal
from rp_jax.runs import tables
from rp_jax.runs.reconnoitre import report_rows
from rp_jax.runs.train import RunResult

ABREAST = 3  # cases that fit a terminal side by side


def show(result: RunResult) -> None:
    """Prints what is known of the threats, and the tables of a run.

    Args:
        result: of the run.
    """
    rows = [] if result.threat is None else report_rows(result.threat)
    if rows:
        show_threats(rows, result.threat.about["x"] if result.threat else 0.0)
    show_table(result.table)


def show_table(table: tables.Table) -> None:
    """Prints one line per fact, one column per case; and what all agents come to together.

    Args:
        table: rows of one method.
    """
    rows = table.rows
    for start in range(0, len(rows), ABREAST):
        _show(rows[start : start + ABREAST])
    if len({row["seed"] for row in rows}) > 1:
        shown = [
            {
                "case": row["variant"],
                "return over agents": tables.earned(row),
                "crashes": tables.crashed(row),
                **tables.rates(row),
            }
            for row in table.summary
        ]
        terminal.table(f"{table.summary[0]['seeds']} agents", shown, list(shown[0]))


def _show(rows: Sequence[Mapping[str, Any]]) -> None:
    cases = [f"{row['variant']} agent {row['seed']}" for row in rows]
    told = [tables.in_words(row) for row in rows]
    lines = [
        {"": name, **{case: words[name] for case, words in zip(cases, told, strict=True)}}
        for name in told[0]
    ]
    terminal.table(f"{rows[0]['env']}: {rows[0]['method']}", lines, ["", *cases])


def show_threats(rows: Sequence[Mapping[str, Any]], x: float, truth: str = "fresh labels") -> None:
    """Prints what the threat models' reports say.

    Args:
        rows: by kind of hazard, of single ones and of sums.
        x: the threshold at which decisions were compared.
        truth: what the models were compared with.
    """
    shown = [
        {
            "hazard": row["hazard"],
            "of": row["of"],
            "mean abs. error": row["mae"],
            "rms error": row["rmse"],
            "bias": row["bias"],
            "rank correlation": row["spearman"],
            "unsafe called safe": f"{100 * row['unsafe_called_safe']:.2f} %",
            "safe called unsafe": f"{100 * row['safe_called_unsafe']:.2f} %",
            "states missed": f"{row['states_missed']} of {row['unsafe_states']}",
        }
        for row in rows
    ]
    terminal.table(f"threat models against {truth} (x = {x:g})", shown, list(shown[0]))


def draw(result: RunResult) -> None:
    """Draws learning_curves.png and threat_fit.png.

    Args:
        result: of a run, in whose folder there is a folder for figures.
    """
    from rp_jax.plot import curves

    figures = result.folder / "figures"
    name = f"{result.world.name}: {result.agents.methods[0]}"
    curves.learning_curves(result.agents.history, name, figures / "learning_curves.png")
    fits = result.folder / "threat" / "curves.json"
    if result.threat is not None and fits.exists():
        from rp_jax.runs.record import read_json

        curves.fit_curves(read_json(fits), figures / "threat_fit.png")
