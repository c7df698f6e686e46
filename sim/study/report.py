"""One self-contained HTML file: every table, every figure with the command that gives it, and every set-up."""

import base64
import html
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sim.study import FLOWN
from sim.study.common import Config, Outcome, Table, study_module

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
h1 { font-size: 1.6rem; }
h2 { margin-top: 3rem; border-bottom: 1px solid #ccc; } h3 { font-size: 1rem; margin-top: 2rem; }
table { border-collapse: collapse; font-size: 13px; display: block; overflow-x: auto; }
th, td { padding: .25rem .6rem; border-bottom: 1px solid #e2e2e2; text-align: right; white-space: nowrap; }
th { text-align: right; vertical-align: bottom; white-space: normal; border-bottom: 2px solid #888; }
th:first-child, td:first-child { text-align: left; }
figure { margin: 1.5rem 0; } figure img { max-width: 100%; } figcaption, .note { color: #555; font-size: 13px; }
pre { background: #f6f6f6; padding: .8rem; font-size: 12px; overflow-x: auto; } code { background: #f2f2f2; }
nav a { margin-right: 1rem; }
"""


def write_report(out: Path, name: str, done: Sequence[tuple[Config, Outcome]], seeds: Sequence[int]) -> Path:
    """Write `report.html` for all studies, NAME.html for one; returns its path."""
    path = out / ("report.html" if name == "all" else f"{name}.html")
    text = (
        f"{seeds[0]}..{seeds[-1]}" if list(seeds) == list(range(seeds[0], seeds[-1] + 1)) else ",".join(map(str, seeds))
    )
    body = [f"<h1>Starling formations: {'every study' if name == 'all' else html.escape(done[0][0].name)}</h1>"]
    flown = all(c.name in FLOWN for c, _ in done)
    chosen = "" if flown else "Parameters were chosen on seeds 0..19 only; claims are judged on 20..39. "
    body.append(
        f"<p>Seeds {text}. {chosen}Every random number comes from seed and vehicle index, so all laws meet the same "
        "disturbances.</p>"
    )
    body.append("<nav>" + "".join(f'<a href="#{c.name}">{c.name}</a>' for c, _ in done) + "</nav>")
    for config, outcome in done:
        command = f"fleet study {config.name} --seeds {text}"
        body.append(f'<h2 id="{config.name}">{html.escape(study_module(config.name).TITLE)}</h2>')
        body.append("<ul>" + "".join(f"<li>{html.escape(f)}</li>" for f in outcome.findings) + "</ul>")
        body += [_table(t, command) for t in outcome.tables]
        for figure in outcome.figures:
            data = base64.b64encode((out / f"{figure.name}.png").read_bytes()).decode()
            body.append(
                f'<figure><img alt="{html.escape(figure.caption)}" src="data:image/png;base64,{data}">'
                f"<figcaption>{html.escape(figure.caption)} <code>{command}</code></figcaption></figure>"
            )
        body.append(
            f"<details><summary>Set-up: {config.name}.toml</summary><pre>{html.escape(config.text)}</pre></details>"
        )
    path.write_text(
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(name)}</title>'
        f"<style>{_STYLE}</style><body>{''.join(body)}</body></html>\n",
        encoding="utf-8",
    )
    return path


def _table(table: Table, command: str) -> str:
    head = "".join(f"<th>{html.escape(c.title)}</th>" for c in table.columns)
    rows = "".join(
        "<tr>" + "".join(f"<td>{html.escape(_cell(row.get(c.key), c.digits))}</td>" for c in table.columns) + "</tr>"
        for row in table.rows
    )
    return (
        f"<h3>{html.escape(table.title)}</h3><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"
        f'<p class="note">{html.escape(table.note)} <code>{command}</code></p>'
    )


def _cell(value: Any, digits: int) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return "–" if math.isnan(value) else f"{value:.{digits}f}"
    return str(value)
