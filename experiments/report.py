"""REPORT.md and report.html from the saved results: the same blocks, written twice.

report.html holds its pictures itself: it opens from the file system, without a network.
"""

import base64
import html
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from experiments.paper.section import Claim, Section
from rp_jax import storage

MEDIA = {".png": "image/png", ".gif": "image/gif"}


class Heading(NamedTuple):
    """A heading of a section (level 2) or of the report (level 1)."""

    text: str
    level: int = 2


class Grid(NamedTuple):
    """A table with a title."""

    title: str
    rows: Sequence[Mapping[str, Any]]


class Figure(NamedTuple):
    """A picture in the report's folder."""

    path: str  # relative
    caption: str


Block = Heading | Grid | Figure | str

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1a202c; max-width: 1100px; margin: 2em auto;
  padding: 0 1em; }
h1, h2 { line-height: 1.2; } h2 { margin-top: 2.5em; border-bottom: 1px solid #cbd5e0; }
.scroll { overflow-x: auto; margin: 1em 0; } table { border-collapse: collapse; font-size: 13px; }
caption { text-align: left; font-weight: 600; padding: .4em 0; white-space: nowrap; }
th, td { border-bottom: 1px solid #e2e8f0; padding: .25em .7em; text-align: left;
  vertical-align: top; }
th { background: #edf2f7; } figure { margin: 1.5em 0; } img { max-width: 100%; }
figcaption { font-size: 13px; color: #4a5568; }
td.exceeded { background: #c6f6d5; } td.reproduced { background: #e6fffa; }
td.not { background: #fed7d7; }
"""


def write(folder: Path, blocks: Sequence[Block]) -> None:
    """Writes REPORT.md and report.html into a folder that holds the pictures."""
    storage.write_bytes(folder / "REPORT.md", "\n".join(markdown(blocks)).encode())
    storage.write_bytes(folder / "report.html", "".join(page(blocks, folder)).encode())


def section(name: str, title: str, told: Section) -> list[Block]:
    """Returns the blocks of a result whose pictures lie in the folder `name`."""
    blocks: list[Block] = [Heading(title), told.text]
    blocks += [Figure(f"{name}/{file}", caption) for file, caption in told.figures.items()]
    blocks += [Grid(table.title, table.rows) for table in told.tables]
    if told.claims:
        blocks.append(verdicts(told.claims))
    return blocks


def verdicts(claims: Iterable[Claim], title: str = "Verdicts") -> Grid:
    """Returns a table with a line per published claim."""
    return Grid(title, [claim._asdict() for claim in claims])


def markdown(blocks: Iterable[Block]) -> Iterable[str]:
    """Yields the lines of REPORT.md."""
    for block in blocks:
        match block:
            case Heading(text, level):
                yield f"{'#' * level} {text}"
            case Figure(path, caption):
                yield f"![{caption}]({path})"
            case Grid(title, rows):
                if not rows:
                    continue
                yield f"**{title}**\n"
                yield f"| {' | '.join(rows[0])} |"
                yield f"|{'---|' * len(rows[0])}"
                for row in rows:
                    yield f"| {' | '.join(str(v).replace('|', '/') for v in row.values())} |"
            case text:
                yield text
        yield ""


def page(blocks: Iterable[Block], folder: Path) -> Iterable[str]:
    """Yields the parts of report.html."""
    yield '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>rp_jax</title>'
    yield f"<style>{STYLE}</style></head><body>\n"
    for block in blocks:
        match block:
            case Heading(text, level):
                yield f"<h{level}>{html.escape(text)}</h{level}>\n"
            case Figure(path, caption):
                said = html.escape(caption)
                yield f'<figure><img src="{data_uri(folder / path)}" alt="{said}">'
                yield f"<figcaption>{said}</figcaption></figure>\n"
            case Grid(title, rows):
                yield from _grid(title, rows)
            case text:
                yield f"<p>{html.escape(text)}</p>\n"
    yield "</body></html>\n"


def _grid(title: str, rows: Sequence[Mapping[str, Any]]) -> Iterable[str]:
    if not rows:
        return
    yield f'<div class="scroll"><table><caption>{html.escape(title)}</caption><tr>'
    yield from (f"<th>{html.escape(name)}</th>" for name in rows[0])
    yield "</tr>\n"
    for row in rows:
        yield "<tr>"
        for name, value in row.items():
            kind = f' class="{str(value).split()[0]}"' if name == "verdict" else ""
            yield f"<td{kind}>{html.escape(str(value))}</td>"
        yield "</tr>\n"
    yield "</table></div>\n"


def data_uri(path: Path) -> str:
    """Returns a picture as text."""
    return f"data:{MEDIA[path.suffix]};base64,{base64.b64encode(path.read_bytes()).decode()}"
