"""A run as one HTML page that needs no server, no script and no other file."""

import base64
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

import numpy as np

from mjstack.report.record import GateResult, Report
from mjstack.report.svg import Map, histogram, table_map
from mjstack.report.table import Table, format_value
from mjstack.report.web import World
from mjstack.report.write import (
    label,
    summarize,
    take_limited,
    take_repeated,
    unit_ending,
    with_unit,
    words,
)

PAGE = "report.html"
_ROWS = 40  # of a table that is not folded
_POINTS = 3000  # starts in a map: a page of more is slow
_NUMBER = re.compile(r"[-+]?[\d,.]+(e[-+]?\d+)?( [^\d\s]{1,4})?|[-+]?(nan|inf)|-")
_TYPES = {".png": "png", ".jpg": "jpeg", ".webp": "webp", ".gif": "gif"}

# "Passed" and "failed" have a colour and a word each: no meaning hangs on the colour alone.
_STYLE = """
:root{--bg:#fff;--fg:#1c2128;--dim:#656d76;--line:#d8dee4;--soft:#f4f6f8;--good:#1a7f4b;
--bad:#c93434;--near:#9a6700;--bar:#4478b8}
@media(prefers-color-scheme:dark){:root{--bg:#14181d;--fg:#e4e8ec;--dim:#98a2ad;--line:#343c46;
--soft:#1d232a;--good:#4cc38a;--bad:#ff7b72;--near:#e0b050;--bar:#79a8e0}}
*{box-sizing:border-box}
body{margin:0 auto;max-width:1180px;padding:1.5rem;background:var(--bg);color:var(--fg);
font:15px/1.5 system-ui,sans-serif}
h1{font-size:1.6rem;margin:0}h2{font-size:1.25rem;margin:2.5rem 0 .3rem;padding-top:.8rem;
border-top:1px solid var(--line)}h3{font-size:1rem;margin:1.4rem 0 .4rem}
small,.dim,figcaption{color:var(--dim);font-size:.85rem;font-weight:400}
a{color:var(--bar)}code{font-size:.85rem;overflow-wrap:anywhere}
.scroll{overflow-x:auto}.side{display:flex;flex-wrap:wrap;gap:0 2.5rem;align-items:flex-start}
table{border-collapse:collapse;font-size:.88rem;margin:.2rem 0 1rem}
th,td{padding:.22rem .7rem;border-bottom:1px solid var(--line);text-align:left;vertical-align:top}
th{font-weight:600;background:var(--soft);white-space:nowrap}
.n{text-align:right;font-variant-numeric:tabular-nums;white-space:nowrap}
.pass,.good{color:var(--good)}.fail,.bad{color:var(--bad)}.skip{color:var(--dim)}
.interrupted,.near{color:var(--near)}b.pass,b.fail,b.skip,b.interrupted{text-transform:uppercase;
font-size:.75rem;letter-spacing:.04em}
td small{display:block}i.rate{display:inline-block;width:12rem;
height:.7rem;border-radius:3px;background:linear-gradient(90deg,var(--c) var(--w),var(--line) 0)}
figure{margin:.5rem 0}.pictures{display:flex;flex-wrap:wrap;gap:1rem}
.pictures figure{flex:1 1 440px}img{max-width:100%;height:auto;border:1px solid var(--line)}
.plots{display:flex;flex-wrap:wrap;gap:.4rem 1.4rem}svg{display:block;overflow:visible}
svg text{font-size:11px;fill:var(--dim)}.g{fill:var(--bar)}.b{fill:var(--bad)}
.o{fill:var(--bar);fill-opacity:.5}.x{stroke:var(--bad);stroke-width:2}
.w{fill:none;stroke:var(--bar);stroke-opacity:.4}.w.x{stroke:var(--bad);stroke-width:1}
.axis{stroke:var(--line)}.limit{stroke:var(--near);stroke-dasharray:4 3}
.go{display:inline-block;padding:.4rem .9rem;border:1px solid var(--bar);border-radius:6px;
text-decoration:none}
"""


@dataclass(kw_only=True, slots=True)
class Worlds:
    """The episodes of a gate, for plots.

    Attributes:
        names: Of the episodes, as ``world=`` of job=replay takes them.
        broken: The rules that each episode broke; empty where it succeeded.
        rules: The rules in words, by name.
        values: Measurements by name with unit, each of shape ``(n,)``.
        maps: Where the objects stood.
    """

    names: Sequence[str]
    broken: Sequence[Sequence[str]]
    rules: Mapping[str, str]
    values: Mapping[str, np.ndarray]
    maps: list[Map] = field(default_factory=list)


@dataclass(kw_only=True, slots=True)
class Page:
    """What a run shows besides its report; its parts fill it in as they go.

    Attributes:
        title: Robot and task.
        worlds: Episodes by gate.
        worlds3d: Worlds in motion, by the part of the run that played them.
        tables: Tables of the run, such as of job=scaling.
        pictures: Files that parts of the run have drawn.
        episode: Name of the file with the episode in 3-D; empty without one.
        note: Why there is none.
    """

    title: str = "mjstack run"
    worlds: dict[str, Worlds] = field(default_factory=dict)
    worlds3d: dict[str, list[World]] = field(default_factory=dict)
    tables: list[Table] = field(default_factory=list)
    pictures: list[str] = field(default_factory=list)
    episode: str = ""
    note: str = ""


def write_page(path: Path, report: Report, page: Page) -> None:
    """Write the page.

    Raises:
        OSError: It cannot be written.
    """
    path.write_text(to_html(report, page), encoding="utf-8")


def to_html(report: Report, page: Page) -> str:
    """The page: summary, pictures, then every gate with its plots and tables, and the
    provenance.
    """
    title = escape(f"{page.title}: {report.status}")
    run = " ".join(report.overrides)
    head = [
        f"<h1>{escape(page.title)} <b class={report.status}>{report.status}</b></h1>",
        f"<p class=dim>{escape(str(report.provenance.get('date', '')))} &middot;"
        f" {escape(str(report.provenance.get('device', '')))}</p>",
        f"<p><code>{escape(run)}</code></p>" if run else "",
        _summary(report.gates),
    ]
    if page.episode:
        link = escape(page.episode)
        head.append(
            f"<p><a class=go href='{link}'>Play it in 3-D: {link}</a>"
            " <small>red tables: failed worlds; blue ones: their copies on native MuJoCo</small>"
            "</p>"
        )
    elif page.note:
        head.append(f"<p class=dim>{escape(page.note)}</p>")
    pictures = [_picture(report.folder / name) for name in report.pictures]
    gates = [_gate(gate, page.worlds.get(gate.name)) for gate in report.gates]
    rows = [[key, words(value)] for key, value in report.provenance.items()]
    facts = _table(Table(header=["fact", "value"], rows=rows))
    body = [
        *head,
        *map(_folded, page.tables),
        f"<div class=pictures>{''.join(pictures)}</div>" if pictures else "",
        *gates,
        f"<h2>Provenance</h2>{facts}",
    ]
    return (
        f"<!doctype html>\n<html lang=en><head><meta charset=utf-8><title>{title}</title>"
        "<meta name=viewport content='width=device-width,initial-scale=1'>"
        "<link rel=icon href='data:,'>"
        f"<style>{_STYLE}</style></head>\n<body>\n" + "\n".join(body) + "\n</body></html>\n"
    )


def _summary(gates: Sequence[GateResult]) -> str:
    """A row per gate, which leads to its section."""
    table = summarize(gates)
    rows = "".join(
        f"<tr><td><a href='#{escape(name)}'>{escape(name)}</a></td>"
        f"<td><b class={escape(status)}>{escape(status)}</b></td>"
        f"<td class=n>{seconds}</td><td>{escape(result)}</td></tr>"
        for name, status, seconds, result in table.rows
    )
    header = "".join(f"<th>{name}</th>" for name in table.header)
    return f"<div class=scroll><table><tr>{header}</tr>{rows}</table></div>"


def _gate(gate: GateResult, worlds: Worlds | None) -> str:
    """A section: result, plots, tables, remarks."""
    metrics = dict(gate.metrics)
    thresholds = dict(gate.thresholds)
    repeated = take_repeated(metrics)
    limited = take_limited(metrics, thresholds)
    parts = [
        f"<h2 id='{escape(gate.name)}'>{escape(gate.name)} <b class={gate.status}>{gate.status}</b>"
        f" <small>{gate.seconds:.1f} s</small></h2>",
        f"<p>{escape(gate.reason)}</p>" if gate.reason else "",
    ]
    if worlds is not None and len(worlds.names):
        parts += _plots(worlds, gate.thresholds)
    if limited:
        parts.append(_limits_table(limited))
    tables = [*gate.tables, *([repeated] if repeated.rows else []), *_matrices(metrics)]
    parts += [f"<h3>{escape(table.title)}</h3>{_table(table)}" for table in tables]
    columns = [_table(table) for table in _beside_limits(metrics, thresholds)]
    if gate.notes:
        rows = [[label(name), format_value(value)] for name, value in gate.notes.items()]
        columns.append(_table(Table(header=["note", ""], rows=rows)))
    parts.append(f"<div class=side>{''.join(columns)}</div>")
    if gate.details:
        lines = "".join(f"<li>{escape(line)}</li>" for line in gate.details)
        parts.append(f"<ul>{lines}</ul>")
    return "\n".join(filter(None, parts))


def _table(table: Table) -> str:
    """A table; a cell that is a number stands to the right."""
    rows = []
    for cells in table.rows:
        tags = ("td class=n" if _NUMBER.fullmatch(cell) else "td" for cell in cells)
        rows.append(
            "".join(f"<{tag}>{escape(cell)}" for tag, cell in zip(tags, cells, strict=True))
        )
    header = "".join(f"<th>{escape(name)}" for name in table.header)
    body = "".join(f"<tr>{row}" for row in rows)
    return f"<div class=scroll><table><tr>{header}{body}</table></div>"


def _folded(table: Table) -> str:
    """A table that a long page shows on request."""
    opened = " open" if len(table.rows) <= _ROWS else ""
    title = escape(table.title)
    return f"<details{opened}><summary>{title}</summary>{_table(table)}</details>"


def _limits_table(cells: Mapping[str, Mapping[str, tuple[float, float]]]) -> str:
    """States down, quantities across: found, the limit below it, and a mark where it is near or
    over.
    """
    columns = list(dict.fromkeys(column for row in cells.values() for column in row))
    out = []
    for name, row in cells.items():
        out.append(f"<tr><td>{escape(name)}")
        for column in columns:
            if column not in row:
                out.append("<td>")
                continue
            found, limit = row[column]
            grade = "good" if found <= 0.5 * limit else "near" if found <= limit else "bad"
            share = f" ({found / limit:.2g})" if limit > 0.0 and math.isfinite(found) else ""
            out.append(
                f"<td class='n {grade}' title='{grade}{share}'>{found:.2g}"
                f"<small>of {limit:.2g}</small>"
            )
    header = "".join(f"<th class=n>{escape(column)}" for column in columns)
    caption = (
        "<p class=dim>Largest difference, and below it what is allowed; green up to half of it, red"
        " beyond it.</p>"
    )
    return (
        f"<h3>Differences</h3>{caption}<div class=scroll><table><tr><th>state{header}"
        f"{''.join(out)}</table></div>"
    )


def _matrices(metrics: dict[str, float]) -> list[Table]:
    """Metrics ``ROW.COLUMN`` of which several rows have the same columns, taken out of the
    mapping.
    """
    rows: dict[str, dict[str, float]] = {}
    for name, value in metrics.items():
        row, dot, column = name.rpartition(".")
        if dot:
            rows.setdefault(row, {})[column] = value
    alike: dict[tuple[str, ...], list[str]] = {}
    for row, held in rows.items():
        alike.setdefault(tuple(held), []).append(row)
    tables = []
    for columns, names in alike.items():
        if len(names) < 2:
            continue
        # The names' common beginning is the title.
        split = [name.split(".") for name in names]
        depth = next(
            (n for n, parts in enumerate(zip(*split, strict=False)) if len(set(parts)) > 1), 0
        )
        title = label(".".join(split[0][:depth])).capitalize() if depth else "By part"
        body = [
            [
                label(".".join(parts[depth:])).replace(":", ","),
                *(with_unit(column, metrics.pop(f"{name}.{column}")) for column in columns),
            ]
            for name, parts in zip(names, split, strict=True)
        ]
        tables.append(Table(title=title, header=["", *(label(c) for c in columns)], rows=body))
    return tables


def _beside_limits(metrics: Mapping[str, float], thresholds: Mapping[str, float]) -> list[Table]:
    """What was measured beside what is required, and the requirements of nothing that was
    measured.
    """
    rows = []
    used: set[str] = set()
    for name, value in metrics.items():
        found = _limits_of(name, thresholds)
        used.update(found)
        limits = " to ".join(with_unit(limit, thresholds[limit]) for limit in found)
        rows.append([label(name), with_unit(name, value), limits])
    rest = [[label(name), with_unit(name, x)] for name, x in thresholds.items() if name not in used]
    tables = []
    if rows:
        header = ["measured", "", "required"]
        if not used:
            header = header[:2]
            rows = [row[:2] for row in rows]
        tables.append(Table(header=header, rows=rows))
    if rest:
        tables.append(Table(header=["required", ""], rows=rest))
    return tables


def _limits_of(name: str, thresholds: Mapping[str, float]) -> list[str]:
    """Names of a measurement's thresholds: its own name, without or with ``_min`` and ``_max``
    before the unit.
    """
    unit = unit_ending(name)
    stem = name.removesuffix(unit)
    for one in (stem, re.sub("_(min|max)$", "", stem)):
        for ends in (("",), ("_min", "_max")):
            found = [f"{one}{end}{unit}" for end in ends if f"{one}{end}{unit}" in thresholds]
            if found:
                return found
    return []


def _plots(worlds: Worlds, thresholds: Mapping[str, float]) -> list[str]:
    """Rate, failures by rule, histograms of what was measured, and maps of the starts."""
    count = len(worlds.names)
    bad = np.array([bool(broken) for broken in worlds.broken])
    good = count - int(bad.sum())
    parts = [f"<p>{_bar(good / count, 'good')} {good:,} of {count:,} succeeded</p>"]
    if bad.any():
        names: dict[str, list[str]] = {}
        for name, rules in zip(worlds.names, worlds.broken, strict=True):
            for rule in rules:
                names.setdefault(rule, []).append(name)
        rows = "".join(
            f"<tr><td>{escape(rule)}<td>{escape(worlds.rules.get(rule, ''))}"
            f"<td class=n>{len(some):,}<td>{_bar(len(some) / count, 'bad')}"
            f"<td>{escape(', '.join(some[:12]))}{', ...' if len(some) > 12 else ''}"
            for rule, some in sorted(names.items(), key=lambda item: -len(item[1]))
        )
        parts.append(
            "<h3>Failures by rule</h3><div class=scroll><table><tr><th>rule<th>meaning"
            f"<th>episodes<th><th>which{rows}</table></div>"
        )
    histograms = [
        histogram(name, values, bad, [thresholds[limit] for limit in _limits_of(name, thresholds)])
        for name, values in worlds.values.items()
    ]
    if any(histograms):
        parts.append(
            "<h3>Over the worlds</h3><p class=dim>Number of episodes; failed ones in red on top,"
            f" thresholds dashed.</p><div class=plots>{''.join(histograms)}</div>"
        )
    if worlds.maps:
        note = ""
        shown = np.arange(count)
        if count > _POINTS:  # failed ones first
            order = np.argsort(~bad, kind="stable")
            shown = np.sort(order[:_POINTS])
            lost = int(bad.sum())
            failed = f"{_POINTS:,} of {lost:,}" if lost > _POINTS else "all"
            note = f" {_POINTS:,} of {count:,} are drawn, {failed} failed ones among them."
        if ways := len(worlds.maps[0].ways):
            note += f" Lines are the objects' ways in {ways} of the episodes."
        drawn = "".join(
            table_map(one, worlds.names, worlds.broken, shown.tolist()) for one in worlds.maps
        )
        parts.append(
            "<h3>Over the table</h3><p class=dim>Where the objects started, seen from above, the"
            f" arm's base at the triangle; failed episodes as red crosses.{note}</p>"
            f"<div class=plots>{drawn}</div>"
        )
    return parts


def _bar(share: float, css: str) -> str:
    """A bar that is filled to a share of its length."""
    return f"<i class=rate style='--w:{100.0 * share:.1f}%;--c:var(--{css})'></i>"


def _picture(path: Path) -> str:
    """A picture with its bytes in the page; empty where it cannot be read."""
    kind = _TYPES.get(path.suffix)
    try:
        held = base64.b64encode(path.read_bytes()).decode() if kind else ""
    except OSError:
        held = ""
    if not held:
        return ""
    name = escape(path.name)
    return (
        f"<figure><img alt='{name}' src='data:image/{kind};base64,{held}'>"
        f"<figcaption>{name}</figcaption></figure>"
    )
