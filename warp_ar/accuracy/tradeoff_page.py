"""The page of ``warp_ar.tradeoff``: one file, no script, nothing from outside; pictures and charts are inside."""

from __future__ import annotations

import base64
import html
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import cv2
import numpy as np

from warp_ar.accuracy.case_report import SAME_ERROR, SAME_TIME, CaseReport, Whole
from warp_ar.accuracy.cases import Image
from warp_ar.accuracy.charts import SIZE, SMALL, Point, scatter
from warp_ar.accuracy.cost_table import SETTINGS, WORDS
from warp_ar.accuracy.metrics import flip_map
from warp_ar.accuracy.pictures import Box, bounding_box, crop, error_colors
from warp_ar.accuracy.progress import Advance, ignore
from warp_ar.accuracy.sweep import Row
from warp_ar.signature import COMMENT

QUALITY = 82
"""Of WebP, for all pictures."""
SHOWN = ("paper", SAME_TIME, "medium", "high")
"""Wholes whose pictures are shown."""
SECTION_UNITS = 0.3
"""Units of work of a section: a chart, and pictures with their errors."""
REAL_TIME = 1e3 / 30.0
"""Milliseconds of a frame at 30 frames per second."""

_STYLE = """
:root{color-scheme:light dark;--page:#fbfbf9;--ink:#1b1c1e;--soft:#5c5f65;--line:#dcdcd6;--card:#fff;--mark:#2f6fdf;
--other:#9a9c9f;--warm:#c2571a}
@media(prefers-color-scheme:dark){:root{--page:#141517;--ink:#ececea;--soft:#a9acb1;--line:#303236;--card:#1c1e21;
--mark:#7aa7ff;--other:#74777c;--warm:#f09a5e}}
*{box-sizing:border-box}html{scroll-behavior:smooth}body{margin:0;background:var(--page);color:var(--ink);
font:15px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue",Arial,sans-serif}
main{max-width:1180px;margin:0 auto;padding:40px 24px 80px}h1{font-size:34px;line-height:1.15;margin:0 0 8px}
h2{font-size:24px;margin:64px 0 4px;padding-top:20px;border-top:1px solid var(--line)}
h3{font-size:17px;margin:40px 0 2px}
p{max-width:76ch;margin:6px 0 14px}.lead{font-size:17px}.soft{color:var(--soft)}a{color:var(--mark)}
nav{display:flex;flex-wrap:wrap;gap:4px 16px;margin:14px 0}
.row{display:grid;gap:6px 8px;margin:12px 0;overflow-x:auto;padding-bottom:4px}.row figure{margin:0;min-width:0}
.row img{width:100%;display:block;border-radius:4px}
figcaption{font-size:13px;line-height:1.35;color:var(--soft);padding:5px 1px 2px;font-variant-numeric:tabular-nums}
figcaption b{color:var(--ink);font-weight:600}
.split{display:grid;grid-template-columns:minmax(0,1fr) minmax(0,1fr);gap:16px;align-items:start}
.many{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(340px,100%),1fr));gap:16px;margin:16px 0}
@media(max-width:900px){.split{grid-template-columns:minmax(0,1fr)}}
.card{background:var(--card);border:1px solid var(--line);border-radius:8px;padding:12px 14px;overflow-x:auto}
.card h4{margin:0 0 6px;font-size:15px}.card p{margin:8px 0 2px;font-size:14px}
table{border-collapse:collapse;width:100%;font-size:13.5px;font-variant-numeric:tabular-nums}
th{font-weight:600;color:var(--soft);text-align:right;border-bottom:1px solid var(--line);padding:3px 6px;
vertical-align:bottom}
td{text-align:right;padding:3px 6px;border-bottom:1px solid var(--line);vertical-align:top}
tr:last-child td{border-bottom:0}td:first-child,th:first-child,td.text{text-align:left}td.text{color:var(--soft)}
tr.out td{color:var(--soft)}tr.head td{font-weight:600;padding-top:12px}
svg{display:block;width:100%;height:auto}
svg text{font-family:inherit;paint-order:stroke;stroke:var(--card);stroke-width:3px;stroke-linejoin:round}
.scale{display:inline-grid;grid-template-columns:repeat(5,44px);vertical-align:middle;margin:0 8px;font-size:11px;
text-align:center}.scale img{grid-column:1/-1;width:100%;height:10px;border-radius:3px}
@media(max-width:600px){main{padding:24px 16px 60px}h1{font-size:28px}
.row{grid-auto-columns:150px}table{font-size:13px}}
"""


# ------------------------------------------------------------------------------------------------------------- pictures


def data_uri(image: Image) -> str:
    """An RGB picture as a data URI.

    Raises:
        ValueError: It cannot be encoded.
    """
    bgr = np.ascontiguousarray(image[..., ::-1])
    done, code = cv2.imencode(".webp", bgr, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    if not done:
        raise ValueError(f"a picture of shape {image.shape} cannot be encoded")
    return f"data:image/webp;base64,{base64.b64encode(code.tobytes()).decode('ascii')}"


def figure(image: Image, caption: str, about: str = "") -> str:
    """A picture and what it is; the caption is HTML, the text for those who do not see it is not."""
    plain = html.escape(about or caption.replace("<b>", "").replace("</b>", ""), quote=True)
    return (
        f'<figure><img loading="lazy" src="{data_uri(image)}" alt="{plain}"><figcaption>{caption}</figcaption></figure>'
    )


def strip(columns: Sequence[tuple[str, Image]], reference: Image | None, box: Box) -> str:
    """Crops side by side, and below each its error against ``reference``."""
    style = f'<div class="row" style="grid-template-columns:repeat({len(columns)},minmax(150px,1fr))">'
    parts = [style, *(figure(crop(image, box), f"<b>{html.escape(label)}</b>", label) for label, image in columns)]
    if reference is not None:
        for label, image in columns:
            if image is reference:
                parts.append("<figure><figcaption>what the others are compared with</figcaption></figure>")
                continue
            errors = flip_map(reference, image)
            text = f"mean FLIP here {errors[box].mean():.3f}"
            parts.append(figure(crop(error_colors(errors), box), text, f"error of {label}"))
    return "".join([*parts, "</div>"])


# --------------------------------------------------------------------------------------------------------------- tables


def table(head: Sequence[str], rows: Iterable[tuple[Sequence[str], bool]]) -> str:
    """A table; rows come with whether they are set back."""
    top = "".join(f"<th>{html.escape(cell)}</th>" for cell in head)
    body = "".join(
        ('<tr class="out">' if out else "<tr>") + "".join(f"<td>{html.escape(cell)}</td>" for cell in cells) + "</tr>"
        for cells, out in rows
    )
    return f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"


def _setting_table(rows: Sequence[Row]) -> str:
    def cells(row: Row) -> list[str]:
        array = row.stage_error
        numbers = (
            ["–", "–", "–"]
            if array is None
            else [f"{array.relative_rmse:.1%}", f"{array.worst:.2f}", f"{array.energy_drift:+.1%}"]
        )
        return [row.method, f"{row.milliseconds:.2f}", f"{row.flip:.4f}", f"{row.error:.4f}", *numbers]

    against = "FLIP to the truth" if rows[0].against == "truth" else "FLIP"
    head = ("method", "ms", against, "its error", "rel. RMSE", "worst", "drift")
    return table(head, ((cells(row), row.dominated) for row in rows))


def _comparisons(rows: Sequence[Row]) -> str:
    """Equal time and equal error within a methods, where a method is beaten by more than a twentieth."""
    lines = []
    for row in rows:
        faster = [other for other in rows if other.milliseconds <= row.milliseconds and other.error < 0.95 * row.error]
        if faster:
            best = min(faster, key=lambda other: other.error)
            lines.append(f"In the time of {row.method}, {best.method} errs {1 - best.error / row.error:.0%} less.")
        same = [other for other in rows if other.error <= row.error and other.milliseconds < 0.95 * row.milliseconds]
        if same:
            best = min(same, key=lambda other: other.milliseconds)
            share = _share(best.milliseconds, row.milliseconds)
            lines.append(f"For the error of {row.method}, {best.method} takes {share} the time.")
    if lines:
        return " ".join(dict.fromkeys(lines))
    if any(row.dominated for row in rows):
        return "No method is beaten by more than a twentieth in time or error."
    return "Every method is Pareto-optimal: none is beaten in both time and error."


def _share(a: float, b: float) -> str:
    return f"{a / b:.0%} of" if b > 0.0 else "none of"


# ------------------------------------------------------------------------------------------------------------- sections


def _beaten(whole: Whole, others: Sequence[Whole]) -> bool:
    return any(
        other.milliseconds <= whole.milliseconds and other.flip <= whole.flip and other is not whole for other in others
    )


_SHORT = {SAME_TIME: "equal time", SAME_ERROR: "equal error"}


def _whole_chart(report: CaseReport, limit: float | None, size: tuple[float, float] = SIZE) -> str:
    points = [
        Point(_SHORT.get(whole.label, whole.label), whole.milliseconds, whole.flip, _beaten(whole, report.wholes))
        for whole in report.wholes
    ]
    against = "truth" if report.case.truth else "reference"
    return scatter(points, "milliseconds per frame", f"error: FLIP to the {against}, per changed pixel", limit, size)


def _glance(report: CaseReport, anchor: str, limit: float | None) -> str:
    """A case in one chart and one sentence."""
    words = html.escape(_whole_words(report.wholes, brief=True))
    return (
        f'<div class="card"><h4><a href="#{anchor}">{html.escape(report.case.name)}</a></h4>'
        f"{_whole_chart(report, limit, SMALL)}<p class=soft>{words}</p></div>"
    )


def _whole_section(report: CaseReport, limit: float | None) -> str:
    index = report.case.shown[-1]
    camera = report.case.frames[index].image
    box = bounding_box(report.region, camera.shape[:2])
    by_label = {whole.label: whole for whole in report.wholes}
    last = ("truth" if report.case.truth else "reference", report.reference[index])
    pictures = [(label, by_label[label].images[index]) for label in SHOWN if label in by_label]
    pixels = "clip" if report.case.darker else "anything virtual changes"
    truth = "the truth, which a path tracer made" if report.case.truth else "the preset <i>reference</i>"
    rows = (
        (
            [whole.label, f"{whole.milliseconds:.2f}", _times(whole.over_paper), f"{whole.flip:.4f}"],
            _beaten(whole, report.wholes),
        )
        for whole in report.wholes
    )
    return "".join(
        [
            f"<p>{len(report.case.frames)} frames of {camera.shape[1]}x{camera.shape[0]}, compared with {truth}. "
            "FLIP is what an observer notices who flips between two pictures, 0 to 1; here it is summed over the "
            f"picture and divided by the pixels that {pixels}. Below the crops are their errors.</p>",
            strip([("camera", camera), *pictures, last], last[1], box),
            '<div class="split"><div class="card">',
            _whole_chart(report, limit),
            '</div><div class="card">',
            table(("as a whole", "ms per frame", "over the paper's", "FLIP"), rows),
            f"<p class=soft>{html.escape(_whole_words(report.wholes))}</p></div></div>",
        ]
    )


def _times(ratio: float) -> str:
    return f"{ratio:.2f}x" if math.isfinite(ratio) else "–"


def _whole_words(wholes: Sequence[Whole], *, brief: bool = False) -> str:
    """Equal time and equal error, in words; as they were measured, in whichever favour."""
    by_label = {whole.label: whole for whole in wholes}
    paper = by_label.get("paper")
    if paper is None:
        return ""
    lines = []
    if SAME_TIME in by_label:
        ours = by_label[SAME_TIME]
        # What took no longer when it was chosen may have taken longer when all ran in turn.
        what = "In the paper's time" if ours.over_paper <= 1.0 else "Nearest to the paper's time, but longer"
        lines.append(
            f"{what} ({_times(ours.over_paper)}; {ours.milliseconds:.1f} ms, the paper's way "
            f"{paper.milliseconds:.1f} ms): {_less(ours.flip, paper.flip)} error."
        )
        lines += [] if brief else [f"It runs {_settings(ours)}."]
    if SAME_ERROR in by_label:
        ours = by_label[SAME_ERROR]
        what = "At the paper's error or less" if ours.flip <= paper.flip else "Nearest to the paper's error, above it"
        lines.append(
            f"{what} ({ours.flip:.3f}, the paper's way {paper.flip:.3f}): {_times(ours.over_paper)} the paper's time."
        )
        lines += [] if brief else [f"It runs {_settings(ours)}."]
    if brief and "high" in by_label:
        high = by_label["high"]
        lines.append(f"High: {_less(high.flip, paper.flip)} error in {_times(high.over_paper)} the time.")
    return " ".join(lines)


def _less(a: float, b: float) -> str:
    """The change from b to a in words."""
    change = 1.0 - a / b if b > 0.0 else 0.0
    return "the same" if abs(change) < 0.005 else f"{change:.0%} less" if change > 0.0 else f"{-change:.0%} more"


def _settings(whole: Whole) -> str:
    return ", ".join(f"{setting.replace('_', ' ')} {method}" for setting, method in whole.settings.items())


def _setting_section(report: CaseReport, rows: Sequence[Row]) -> str:
    setting = rows[0].setting
    index = report.case.shown[-1]
    pictures = [(row.method, report.pictures[setting, row.method]) for row in rows]
    reference = report.reference[index] if report.case.truth else pictures[-1][1]
    # Where the methods differ is what there is to see.
    difference = np.abs(pictures[0][1].astype(int) - pictures[-1][1].astype(int)).max(-1)
    box = bounding_box(difference > max(4, int(0.3 * difference.max())), difference.shape)
    columns = [*pictures, ("truth", reference)] if report.case.truth else pictures
    points = [Point(row.method, row.milliseconds, row.error, row.dominated) for row in rows]
    about = next((name.converges for name in SETTINGS if name.name == setting), True) or not report.case.truth
    against = f"error: FLIP to {rows[-1].method}" if about else "error: FLIP to the truth, above the best method's"
    what, words = WORDS.get(setting, ("", {}))
    legend = "; ".join(
        f"<b>{html.escape(row.method)}</b> {html.escape(words[row.method])}" for row in rows if row.method in words
    )
    return "".join(
        [
            f"<h3>{html.escape(setting.replace('_', ' '))}</h3>",
            f'<p class="soft">{html.escape(what.capitalize())}{": " if legend else ""}{legend}.</p>' if what else "",
            '<div class="split"><div class="card">',
            scatter(points, "milliseconds of its stages per frame", against),
            '</div><div class="card">',
            _setting_table(rows),
            f"<p class=soft>{html.escape(_comparisons(rows))}</p></div></div>",
            strip(columns, reference, box),
        ]
    )


def _list_section(reports: Sequence[CaseReport]) -> str:
    """Every method of every setting over all cases: the cost table itself."""
    body = []
    for setting in SETTINGS:
        rows = [row for report in reports for row in report.rows if row.setting == setting.name]
        if not rows:
            continue
        what, words = WORDS.get(setting.name, ("", {}))
        title = f"{setting.name.replace('_', ' ')} <span class=soft>{html.escape(what)}</span>"
        body.append(f'<tr class="head"><td colspan="5">{title}</td></tr>')
        for method in setting.methods:
            own = [row for row in rows if row.method == method]
            if not own:
                continue
            out = ' class="out"' if all(row.dominated for row in own) else ""
            costs = [row.milliseconds for row in own]
            spread = f"{min(costs):.2f}" if len(costs) == 1 else f"{min(costs):.2f} – {max(costs):.2f}"
            body.append(
                f'<tr{out}><td>{html.escape(method)}</td><td class="text">{html.escape(words.get(method, ""))}</td>'
                f"<td>{spread}</td><td>{sum(row.error for row in own) / len(own):.4f}</td><td>{len(own)}</td></tr>"
            )
    return (
        '<section id="list"><h2>The cost table</h2><p>Every method over all scenes. Its error is FLIP per changed '
        "pixel: where methods approximate one quantity, the distance from the most exact; where they are models, "
        "the distance from the truth above that of the best. Grey: in every scene another method costs no more and "
        'errs no more.</p><div class="card"><table><thead><tr><th>method</th>'
        '<th style="text-align:left">what it does</th>'
        "<th>ms per frame</th><th>error</th><th>scenes</th></tr></thead>"
        f"<tbody>{''.join(body)}</tbody></table></div></section>"
    )


def page_units(settings: Iterable[int]) -> float:
    """Units of work, in runs at a usual method, that ``render`` reports as done, by numbers of settings per case."""
    return SECTION_UNITS * sum(count + 2 for count in settings)


def _is_by_clock(made: Mapping[str, Any]) -> bool:
    """Return whether milliseconds are those of the clock, not of processors."""
    return bool(made.get("clock", "time") == "time")


def _introduction(made: Mapping[str, Any]) -> str:
    """The page's head, and how it is read."""
    by_clock = _is_by_clock(made)
    counted = "" if by_clock else " Milliseconds are processor time: the work of one thread that does it all."
    ramp = error_colors(np.linspace(0.0, 1.0, 128)[None].repeat(4, 0) ** 2)
    # The ramp's colours go with the root of the error.
    marks = "".join(f"<span>{mark * mark:.2g}</span>" for mark in np.linspace(0.1, 0.9, 5))
    return (
        f'<!doctype html>{COMMENT}<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1"><title>What accuracy costs</title>'
        f"<style>{_STYLE}</style></head><body><main><h1>What accuracy costs</h1>"
        '<p class="lead">Every stage has methods, from the paper\'s way to brute force. Here is what each takes and '
        "what it errs: lower is truer, further left is faster.</p>"
        f'<p class="soft">Measured on {html.escape(str(made["device"]))} with Warp {html.escape(str(made["warp"]))}, '
        f"marker tracking left out.{counted} Filled points are the Pareto front; of hollow grey ones "
        "another costs less and errs less. <b>Equal time</b> is sought as the choice that errs least by the cost table "
        "and takes no longer than the paper's way (the cheapest, where all take longer), <b>equal error</b> as the "
        "cheapest that errs no more; what they took and erred when all ran in turn is stated for each scene.</p>"
        f'<p class="soft">Error maps show FLIP: <span class="scale"><img alt="black to yellow" src="{data_uri(ramp)}">'
        f"{marks}</span></p>"
    )


def render(
    reports: Sequence[CaseReport],
    made: Mapping[str, Any],
    advance: Advance = ignore,
) -> str:
    """The whole page.

    Args:
        reports: One per case.
        made: On what it was measured: ``device``, ``warp``, and what ``clock`` counts, ``time`` or ``processor time``.
        advance: Told of every section that is written.
    """

    def told(text: str, section: str) -> str:
        advance(f"page: {text}", SECTION_UNITS)
        return section

    anchors = [(f"case{index}", report) for index, report in enumerate(reports)]
    whole = [(anchor, report) for anchor, report in anchors if report.wholes]
    limit = REAL_TIME if _is_by_clock(made) else None
    parts = [
        _introduction(made),
        "<nav>",
        *(f'<a href="#{anchor}">{html.escape(report.case.name)}</a>' for anchor, report in anchors),
        '<a href="#list">The cost table</a>',
        "</nav>",
        '<div class="many">' if whole else "",
        *(told(report.case.name, _glance(report, anchor, limit)) for anchor, report in whole),
        "</div>" if whole else "",
    ]
    parts.append(_list_section(reports))
    for anchor, report in anchors:
        parts.append(f'<section id="{anchor}"><h2>{html.escape(report.case.name)}</h2>')
        parts.append(told(report.case.name, _whole_section(report, limit)) if report.wholes else "")
        for name, rows in itertools.groupby(report.rows, lambda row: row.setting):
            parts.append(told(f"{report.case.name}: {name}", _setting_section(report, list(rows))))
        parts.append("</section>")
    parts.append("</main></body></html>\n")
    return "".join(parts)
