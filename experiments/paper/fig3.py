"""Figure 3: Frozen Lake, return and danger against the bound c, for several baseline policies."""

from pathlib import Path
from typing import Any

from experiments import frozen_lake
from experiments.figures import words
from experiments.paper.scores import read
from experiments.paper.section import Claim, Section, Table, holds

TITLE = "Figure 3: Frozen Lake against the bound c"
NEGLIGIBLE = 0.01  # of the return
MARGIN = 2  # danger below c / MARGIN is well below c
NEAR = 0.95  # of the optimum


def run(sources: Any, folder: Path) -> dict[str, Any]:
    """Rows per lake, rule, baseline and c, and the exact optima."""
    lake = sources("frozen_lake")
    return {"rows": read(lake / "table.json"), "optima": read(lake / "optima.json")["optima"]}


def plot(results: dict[str, Any], folder: Path) -> None:
    """Figures 3a and 3b, and what each threshold rule earns of the optimum."""
    frozen_lake.plot_rules({name: words.told(rows) for name, rows in results.items()}, folder)


def tell(results: dict[str, Any]) -> Section:
    """The claims of section 5.2; rule "paper" is Corollary 2."""
    rows = results["rows"]
    safe = [row for row in rows if row["rule"] == "paper" and row["safe_baseline"]]
    worst = max(safe, key=lambda row: row["danger"] / row["c"])
    best = _returns(safe)
    lakes = list(dict.fromkeys(row["variant"] for row in rows))
    gaps = {lake: best["eta*", lake] - best["eta 2", lake] for lake in lakes}
    same = [lake for lake, gap in gaps.items() if gap <= NEGLIGIBLE]
    second = [row for row in safe if row["baseline"] == "eta 2" and row["share"] is not None]
    shares = {lake: min(r["share"] for r in second if r["variant"] == lake) for lake in lakes}
    wide = [row for row in safe if row["danger"] * MARGIN < row["c"]]
    claims = [
        Claim(
            "Figure 3b: RP keeps c for every (safe) baseline policy",
            "danger at most c",
            f"greatest danger {worst['danger']:.4f} at c = {worst['c']:g} "
            f"({worst['baseline']}, {worst['variant']})",
            holds(all(row["danger"] <= row["c"] for row in safe)),
        ),
        Claim(
            f"Figure 3b: by a large margin (danger below c / {MARGIN})",
            "large",
            f"danger below c / {MARGIN} in {len(wide)} of {len(safe)} cases",
            holds(len(wide) == len(safe)),
        ),
        Claim(
            "Figure 3a: with the random baseline eta 0 there is no reward",
            "0",
            "; ".join(f"{lake}: {best.get(('eta 0', lake), 0.0):.3f} at most" for lake in lakes),
            holds(max(best.get(("eta 0", lake), 0.0) for lake in lakes) <= NEGLIGIBLE),
        ),
        Claim(
            "Figure 3a: differences are negligible after two policy iteration steps",
            "negligible",
            "; ".join(f"{lake}: eta 2 earns {gap:.3f} less" for lake, gap in gaps.items()),
            holds(len(same) == len(lakes)),
        ),
        Claim(
            "Section 5.2: two steps are enough to obtain a near-optimal policy",
            f"near-optimal ({100 * NEAR:.0f} %)",
            "; ".join(f"{lake}: {100 * s:.0f} % of the optimum" for lake, s in shares.items()),
            holds(min(shares.values()) >= NEAR),
        ),
    ]
    lines = [
        {
            "lake": row["variant"],
            "c": f"{row['c']:g}",
            "rule": row["rule"],
            "return": f"{row['return_mean']:.3f}",
            "danger": f"{row['danger']:.4f}",
            "exact optimum": f"{row['optimum']:.3f}",
        }
        for row in rows
        if row["baseline"] == "eta*" and row["c"] == 0.1 and row["safe_baseline"]
    ]
    return Section(
        "Exact: value iteration, per-step sets. Holes that end the episode (paper's text) and "
        "holes in which each step costs 1 (released code).",
        tables=[Table("Threshold rules, baseline eta*, c = .1", lines)],
        claims=claims,
        figures={
            "figure_3.png": "Return and danger against c, by baseline policy; rule of Corollary 2.",
            "rules.png": "What each threshold rule earns of the exact optimum.",
        },
    )


def _returns(rows: list[dict[str, Any]]) -> dict[tuple[str, str], float]:
    """The highest return at any c, by baseline and lake."""
    found: dict[tuple[str, str], float] = {}
    for row in rows:
        key = (row["baseline"], row["variant"])
        found[key] = max(found.get(key, 0.0), row["return_mean"])
    return found
