"""HTML page of ``warp_ar.tradeoff``: one file with pictures and charts, without scripts or links to other files."""

from __future__ import annotations

import base64
import html
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import cv2
import numpy as np

from warp_ar.accuracy.cases import Image
from warp_ar.accuracy.charts import SIZE, SMALL, Point, scatter
from warp_ar.accuracy.cost_table import SETTINGS, WORDS
from warp_ar.accuracy.measure import SAME_ERROR, SAME_TIME, CaseReport, Row, Whole
from warp_ar.accuracy.metrics import flip_map
from warp_ar.accuracy.pictures import Box, bounding_box, crop, error_colors
from warp_ar.signature import COMMENT

QUALITY = 82
"""WebP quality of all pictures."""
SHOWN = ("paper", SAME_TIME, "medium", "high")
"""Presets and choices whose pictures are shown."""
REAL_TIME = 1e3 / 30.0
"""Milliseconds of a frame at 30 frames per second."""

_STYLE = """
body{margin:0;background:#fbfbf9;color:#1b1c1e;font:15px/1.5 system-ui,sans-serif}
main{max-width:1180px;margin:0 auto;padding:24px}h2{margin:64px 0 4px;padding-top:20px;border-top:1px solid #dcdcd6}
p{max-width:76ch}.lead{font-size:17px}.soft,figcaption,th,tr.out td{color:#5c5f65}a{color:#2f6fdf}
nav{display:flex;flex-wrap:wrap;gap:4px 16px}
.row{display:grid;gap:6px 8px;overflow-x:auto}figure{margin:0;min-width:0}
.row img,svg{display:block;width:100%;height:auto}
.split,.many{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(340px,100%),1fr));gap:16px;align-items:start}
.card{background:#fff;border:1px solid #dcdcd6;border-radius:8px;padding:12px 14px;overflow-x:auto}
figcaption,table{font-size:13px;font-variant-numeric:tabular-nums}table{border-collapse:collapse;width:100%}
th,td{text-align:right;padding:3px 6px;border-bottom:1px solid #dcdcd6;vertical-align:top}
td:first-child,th:first-child{text-align:left}tr.head td{font-weight:600;padding-top:12px}
.scale{display:inline-grid;grid-template-columns:repeat(5,44px);font-size:11px;text-align:center}
.scale img{grid-column:1/-1;width:100%;height:10px}
"""

Cells = Sequence[str]


def data_uri(image: Image) -> str:
    """Return an RGB picture as a data URI (WebP).

    Raises:
        ValueError: The picture cannot be encoded.
    """
    bgr = np.ascontiguousarray(image[..., ::-1])
    done, code = cv2.imencode(".webp", bgr, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    if not done:
        raise ValueError(f"a picture of shape {image.shape} cannot be encoded")
    return f"data:image/webp;base64,{base64.b64encode(code.tobytes()).decode('ascii')}"


def figure(image: Image, caption: str) -> str:
    """Return the HTML of a picture and its caption."""
    text = html.escape(caption, quote=True)
    return f'<figure><img loading="lazy" src="{data_uri(image)}" alt="{text}"><figcaption>{text}</figcaption></figure>'


def strip(columns: Mapping[str, Image], reference: Image, box: Box) -> str:
    """Return the HTML of crops side by side, with the FLIP between each crop and the reference below it.

    Args:
        columns: Pictures by their captions.
        reference: Picture with which they are compared.
        box: Part of the pictures that is shown.
    """
    parts = [figure(crop(image, box), label) for label, image in columns.items()]
    for label, image in columns.items():
        errors = flip_map(reference, image)
        parts.append(figure(crop(error_colors(errors), box), f"{label}: mean FLIP here {errors[box].mean():.3f}"))
    style = f"grid-template-columns:repeat({len(columns)},minmax(150px,1fr))"
    return f'<div class="row" style="{style}">{"".join(parts)}</div>'


def table(head: Cells, rows: Iterable[tuple[Cells, bool]]) -> str:
    """Return the HTML of a table.

    Args:
        head: Names of the columns.
        rows: Cells of each row, and True if it is grey; a row with a single cell is a heading.
    """
    top = "".join(f"<th>{html.escape(cell)}</th>" for cell in head)
    body = []
    for cells, out in rows:
        if len(cells) == 1:
            body.append(f'<tr class="head"><td colspan="{len(head)}">{html.escape(cells[0])}</td></tr>')
            continue
        inner = "".join(f"<td>{html.escape(cell)}</td>" for cell in cells)
        body.append(f'<tr class="{"out" if out else "in"}">{inner}</tr>')
    return f"<table><thead><tr>{top}</tr></thead><tbody>{''.join(body)}</tbody></table>"


def split(chart: str, other: str, words: str) -> str:
    """Return the HTML of a chart with a table and a sentence next to it."""
    words = f"<p class=soft>{html.escape(words)}</p>" if words else ""
    return f'<div class="split"><div class="card">{chart}</div><div class="card">{other}{words}</div></div>'


def _is_beaten(whole: Whole, others: Sequence[Whole]) -> bool:
    return any(
        other.milliseconds <= whole.milliseconds and other.flip <= whole.flip and other is not whole for other in others
    )


_SHORT = {SAME_TIME: "equal time", SAME_ERROR: "equal error"}


def _whole_chart(report: CaseReport, limit: float | None, size: tuple[float, float] = SIZE) -> str:
    points = [
        Point(_SHORT.get(whole.label, whole.label), whole.milliseconds, whole.flip, _is_beaten(whole, report.wholes))
        for whole in report.wholes
    ]
    against = "truth" if report.case.truth else "reference"
    return scatter(points, "milliseconds per frame", f"error: FLIP to the {against}, per changed pixel", limit, size)


def _whole_section(report: CaseReport, limit: float | None) -> str:
    index = report.case.shown[-1]
    camera = report.case.frames[index].image
    by_label = {whole.label: whole for whole in report.wholes}
    pictures = {label: by_label[label].images[index] for label in SHOWN if label in by_label}
    pixels = "clip" if report.case.darker else "anything virtual changes"
    truth = "the truth, which a path tracer made" if report.case.truth else "the preset reference"
    rows = (
        (
            (whole.label, f"{whole.milliseconds:.2f}", _times(whole.over_paper), f"{whole.flip:.4f}"),
            _is_beaten(whole, report.wholes),
        )
        for whole in report.wholes
    )
    lead = (
        f"<p>{len(report.case.frames)} frames of {camera.shape[1]}x{camera.shape[0]}, compared with {truth}. FLIP is "
        "summed over the picture and divided by the pixels that "
        f"{pixels}. Below the crops are their errors.</p>"
    )
    columns = {"camera": camera, **pictures, "truth" if report.case.truth else "reference": report.reference[index]}
    crops = strip(columns, report.reference[index], bounding_box(report.region, camera.shape[:2]))
    head = ("as a whole", "ms per frame", "over the paper's", "FLIP")
    return lead + crops + split(_whole_chart(report, limit), table(head, rows), whole_words(report.wholes))


def _times(ratio: float) -> str:
    return f"{ratio:.2f}x" if math.isfinite(ratio) else "–"


def whole_words(wholes: Sequence[Whole]) -> str:
    """Return sentences on time and error of our choices relative to the preset ``paper``; empty without that preset."""
    by_label = {whole.label: whole for whole in wholes}
    paper = by_label.get("paper")
    if paper is None or paper.flip <= 0.0:
        return ""
    said = {SAME_TIME: "Chosen for the paper's time", SAME_ERROR: "Chosen for the paper's error", "high": "High"}
    return " ".join(
        f"{words}: {_less(by_label[label].flip, paper.flip)} error in {_times(by_label[label].over_paper)} the time."
        for label, words in said.items()
        if label in by_label
    )


def _less(a: float, b: float) -> str:
    """Return the relative change from b to a in words, such as "20% less"."""
    change = 1.0 - a / b
    return "the same" if abs(change) < 0.005 else f"{change:.0%} less" if change > 0.0 else f"{-change:.0%} more"


def _setting_section(report: CaseReport, rows: Sequence[Row]) -> str:
    setting = next(one for one in SETTINGS if one.name == rows[0].setting)
    index = report.case.shown[-1]
    pictures = {row.method: report.pictures[setting.name, row.method] for row in rows}
    first, *_, last = [report.pictures[setting.name, row.method] for row in (*rows, rows[-1])]
    reference = report.reference[index] if report.case.truth else last
    # The crop shows where the methods differ.
    difference = np.abs(first.astype(int) - last.astype(int)).max(-1)
    box = bounding_box(difference > max(4, int(0.3 * difference.max())), difference.shape)
    columns = {**pictures, "truth": reference} if report.case.truth else pictures
    points = [Point(row.method, row.milliseconds, row.error, row.dominated) for row in rows]
    to_last = setting.converges or not report.case.truth
    against = f"error: FLIP to {rows[-1].method}" if to_last else "error: FLIP to the truth, above the best method's"
    what, words = WORDS.get(setting.name, ("", {}))
    legend = "; ".join(f"{row.method}: {words[row.method]}" for row in rows if row.method in words)
    cells = (
        ((row.method, f"{row.milliseconds:.2f}", f"{row.flip:.4f}", f"{row.error:.4f}"), row.dominated) for row in rows
    )
    head = ("method", "ms more", "FLIP to the truth" if rows[0].against == "truth" else "FLIP", "its error")
    chart = scatter(points, "milliseconds per frame, more than the cheapest", against)
    return (
        f"<h3>{html.escape(setting.name.replace('_', ' '))}</h3>"
        f'<p class="soft">{html.escape(what.capitalize())}. {html.escape(legend)}</p>'
        + split(chart, table(head, cells), "")
        + strip(columns, reference, box)
    )


def _list_section(reports: Sequence[CaseReport]) -> str:
    """Return the section with the cost table: every method of every setting, over all cases."""
    rows: list[tuple[Cells, bool]] = []
    for setting in SETTINGS:
        measured = [row for report in reports for row in report.rows if row.setting == setting.name]
        what, words = WORDS.get(setting.name, ("", {}))
        if measured:
            rows.append(((f"{setting.name.replace('_', ' ')}: {what}",), False))
        for method in setting.methods:
            own = [row for row in measured if row.method == method]
            if not own:
                continue
            costs = sorted(row.milliseconds for row in own)
            spread = f"{costs[0]:.2f}" if len(costs) == 1 else f"{costs[0]:.2f} – {costs[-1]:.2f}"
            error = f"{sum(row.error for row in own) / len(own):.4f}"
            rows.append(
                ((method, words.get(method, ""), spread, error, str(len(own))), all(row.dominated for row in own))
            )
    return (
        '<section id="list"><h2>The cost table</h2><p>Every method over all scenes. Its error is FLIP per changed '
        "pixel: where methods approximate one quantity, the distance from the most exact; where they are models, "
        "the distance from the truth above that of the best. Grey: in every scene another method costs no more and "
        'errs no more.</p><div class="card">'
        + table(("method", "what it does", "ms per frame, more than the cheapest", "error", "scenes"), rows)
        + "</div></section>"
    )


def _introduction(made: Mapping[str, Any], *, by_clock: bool) -> str:
    """Return the page's head and introduction.

    Args:
        made: Conditions of the measurement.
        by_clock: True if times are elapsed time, False if they are processor time.
    """
    counted = "" if by_clock else " Milliseconds of whole frames are processor time, of all threads."
    ramp = error_colors(np.linspace(0.0, 1.0, 128)[None].repeat(4, 0) ** 2)
    # The colour ramp follows the square root of the error.
    marks = "".join(f"<span>{mark * mark:.2g}</span>" for mark in np.linspace(0.1, 0.9, 5))
    return (
        f'<!doctype html>{COMMENT}<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1"><title>What accuracy costs</title>'
        f"<style>{_STYLE}</style></head><body><main><h1>What accuracy costs</h1>"
        '<p class="lead">Every stage has methods, from the paper\'s way to brute force. Here is what each takes and '
        "what it errs: lower is truer, further left is faster.</p>"
        f'<p class="soft">Measured on {html.escape(str(made["device"]))} with Warp {html.escape(str(made["warp"]))}, '
        f"marker tracking left out.{counted} Filled points are the Pareto front; of hollow grey ones "
        "another costs less and errs less. <b>Equal time</b> is the choice that errs least by the cost table in the "
        "time of the paper's way, <b>equal error</b> the cheapest that errs no more by it; what they took and erred "
        "when all ran in turn is stated for each scene.</p>"
        f'<p class="soft">Error maps show FLIP: <span class="scale"><img alt="black to yellow" src="{data_uri(ramp)}">'
        f"{marks}</span></p>"
    )


def render(reports: Sequence[CaseReport], made: Mapping[str, Any]) -> str:
    """Return the whole page.

    Args:
        reports: One report per case.
        made: Conditions of the measurement: ``device``, ``warp`` (version), and ``clock``, which is ``time`` or
            ``processor time``.
    """
    by_clock = made.get("clock", "time") == "time"
    limit = REAL_TIME if by_clock else None
    cases = {f"case{index}": report for index, report in enumerate(reports)}
    kinds = {anchor: "presets" if report.wholes else "methods" for anchor, report in cases.items()}
    names = {anchor: f"{html.escape(report.case.name)}: {kinds[anchor]}" for anchor, report in cases.items()}
    links = [f'<a href="#{anchor}">{name}</a>' for anchor, name in names.items()]
    glances = [
        f'<div class="card"><h4>{link}</h4>{_whole_chart(report, limit, SMALL)}'
        f"<p class=soft>{html.escape(whole_words(report.wholes))}</p></div>"
        for link, report in zip(links, cases.values(), strict=True)
        if report.wholes
    ]
    parts = [
        _introduction(made, by_clock=by_clock),
        f'<nav>{"".join(links)}<a href="#list">The cost table</a></nav><div class="many">{"".join(glances)}</div>',
        _list_section(reports),
    ]
    for anchor, report in cases.items():
        parts.append(f'<section id="{anchor}"><h2>{names[anchor]}</h2>')
        parts.append(_whole_section(report, limit) if report.wholes else "")
        parts += [
            _setting_section(report, list(rows)) for _, rows in itertools.groupby(report.rows, lambda row: row.setting)
        ]
        parts.append("</section>")
    return "".join([*parts, "</main></body></html>\n"])
