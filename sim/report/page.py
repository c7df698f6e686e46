"""A flight's page: one HTML file that loads nothing from anywhere."""

from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from html import escape
from pathlib import Path
from typing import Any

from companion.errors import CompanionError
from companion.terminal import one_line, printable
from sim.launch.summary.flight import Flight
from sim.launch.summary.view import summary_rows
from sim.report.drawings import drawings
from sim.report.series import series_of

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #111; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; border-bottom: 1px solid #ccc; }
table { border-collapse: collapse; }
td, th { padding: .2rem .8rem .2rem 0; text-align: left; vertical-align: top; }
th { font-weight: 600; border-bottom: 1px solid #ccc; }
figure { margin: 1rem 0; } svg { max-width: 100%; height: auto; }
figcaption { color: #444; } pre { background: #f6f6f6; padding: .8rem; overflow-x: auto; font-size: 13px; }
.met { color: #006b3c; } .unmet { color: #b00020; font-weight: 600; }
"""


def write_page(flight: Flight, summary: Mapping[str, Any], path: Path) -> None:
    """Write the page; CompanionError if the file cannot be written."""
    text = page(flight, summary)
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise CompanionError(f"cannot write {path}: {error.strerror}") from error


def page(flight: Flight, summary: Mapping[str, Any]) -> str:
    """The page's text. Whatever vehicles and files said is escaped, and printable."""
    config = flight.config
    began = datetime.fromtimestamp(flight.takeoff_ns * 1e-9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    passed = bool(summary["passed"])
    verdict = f'<span class="{"met" if passed else "unmet"}">{"passed" if passed else "not passed"}</span>'
    series = series_of(flight)
    source = "the simulator's truth" if series.true else "the vehicles' own estimates"
    parts = [
        f"<h1>Flight of {_safe(config.fleet.name)}, {began}: {verdict}</h1>",
        f"<p>{len(series.ids)} vehicles. Motion is drawn from {source}; frames are north, east, down.</p>",
        "<h2>Criteria</h2>",
        _table(("what", "value", "limit", ""), [_criterion(c) for c in summary["criteria"]]),
        "<h2>Figures</h2>",
        _table((), [(name, _safe(str(value))) for name, value in summary_rows(summary)]),
    ]
    for title, says, svg in drawings(series, config):
        parts.append(f"<h2>{_safe(title)}</h2><figure>{svg}<figcaption>{_safe(says)}</figcaption></figure>")
    parts += [
        "<h2>Versions</h2>",
        _table((), [(_safe(k), _safe(str(v))) for k, v in summary["versions"].items()]),
        "<h2>Configuration</h2>",
        f"<p>Digest of what the vehicles share: {config.shared_hash}</p>",
        f"<pre>{_safe_lines(config.model_dump_json(indent=1, exclude_none=True))}</pre>",
    ]
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'; "
        'img-src data:">'
        f"<title>{_safe(config.fleet.name)} {began}</title><style>{_STYLE}</style></head><body>\n"
        + "\n".join(parts)
        + "\n</body></html>\n"
    )


def _criterion(c: Mapping[str, Any]) -> tuple[str, str, str, str]:
    word = '<span class="met">met</span>' if c["met"] else '<span class="unmet">not met</span>'
    return _safe(c["what"]), _safe(str(c["value"])), _safe(c["limit"]), word


def _table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    """Cells are HTML already."""
    top = f"<tr>{''.join(f'<th>{h}</th>' for h in head)}</tr>" if head else ""
    return f"<table>{top}{''.join('<tr>' + ''.join(f'<td>{c}</td>' for c in row) + '</tr>' for row in rows)}</table>"


def _safe(said: str) -> str:
    return escape(one_line(said))


def _safe_lines(said: str) -> str:
    return escape(printable(said))
