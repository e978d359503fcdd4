"""The page of ``warp_ar.tradeoff``: one file, no script, nothing from outside; pictures and charts are inside."""

from __future__ import annotations

import base64
import html
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.metrics import flip_map

if TYPE_CHECKING:
    from warp_ar.tradeoff import CaseReport, Figure, Row, Whole

Image = npt.NDArray[np.uint8]
Box = tuple[slice, slice]

PHOTO_QUALITY = 90
"""Of JPEG, for photographs."""
CROP_SIDE = 300
"""Crops are scaled to about this many pixels across."""
CROP_ASPECT = 4.0 / 3.0
"""Width over height of a crop."""
PLOT = (560, 300)
"""Width and height of a chart."""
MARGIN = (58, 18, 18, 44)
"""Left, right, top, bottom of a chart's plotting area."""

_STYLE = """
:root{--page:#fbfbf9;--ink:#1b1c1e;--soft:#62656b;--line:#dcdcd6;--card:#fff;--mark:#2f6fdf;--other:#9a9c9f;--warm:#c2571a}
@media(prefers-color-scheme:dark){:root{--page:#141517;--ink:#ececea;--soft:#a0a3a8;--line:#303236;--card:#1c1e21;
--mark:#7aa7ff;--other:#74777c;--warm:#f09a5e}}
*{box-sizing:border-box}body{margin:0;background:var(--page);color:var(--ink);
font:15px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue",Arial,sans-serif}
main{max-width:1180px;margin:0 auto;padding:40px 24px 80px}h1{font-size:34px;line-height:1.15;margin:0 0 8px}
h2{font-size:24px;margin:64px 0 4px;padding-top:20px;border-top:1px solid var(--line)}
h3{font-size:17px;margin:36px 0 8px}
p{max-width:72ch;margin:6px 0 14px}.soft{color:var(--soft)}nav a{margin-right:16px}a{color:var(--mark)}
.row{display:grid;gap:6px 8px;margin:12px 0}.row figure{margin:0;min-width:0}.row img{width:100%;display:block;
border-radius:4px}figcaption{font-size:13px;color:var(--soft);padding:5px 1px 2px;font-variant-numeric:tabular-nums}
figcaption b{color:var(--ink);font-weight:600}.split{display:grid;grid-template-columns:minmax(0,1fr) minmax(0,1fr);
gap:16px;align-items:start}@media(max-width:900px){.split{grid-template-columns:1fr}}
.card{background:var(--card);border:1px solid var(--line);border-radius:8px;padding:12px 14px;overflow-x:auto}
table{border-collapse:collapse;width:100%;font-size:13.5px;font-variant-numeric:tabular-nums}
th{font-weight:600;color:var(--soft);text-align:right;border-bottom:1px solid var(--line);padding:3px 6px}
td{text-align:right;padding:3px 6px;border-bottom:1px solid var(--line)}tr:last-child td{border-bottom:0}
td:first-child,th:first-child{text-align:left}tr.out td{color:var(--soft)}svg{display:block;width:100%;height:auto}
svg text{fill:var(--soft);font-size:12px}svg .label{fill:var(--ink)}svg .axis{stroke:var(--line)}
svg .on{fill:var(--mark)}svg .off{fill:none;stroke:var(--other);stroke-width:1.6}
svg .front{fill:none;stroke:var(--mark);stroke-width:1.6;opacity:.55}
.scale{display:inline-block;width:150px;height:10px;border-radius:3px;vertical-align:middle;margin:0 8px}
"""


# ------------------------------------------------------------------------------------------------------------- pictures


def data_uri(image: npt.NDArray[np.uint8], *, photo: bool) -> str:
    """An RGB picture as a data URI: JPEG for photographs, else PNG."""
    bgr = np.ascontiguousarray(image[..., ::-1])
    done, code = (
        cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, PHOTO_QUALITY]) if photo else cv2.imencode(".png", bgr)
    )
    if not done:
        raise ValueError(f"a picture of shape {image.shape} cannot be encoded")
    kind = "jpeg" if photo else "png"
    return f"data:image/{kind};base64,{base64.b64encode(code.tobytes()).decode('ascii')}"


def error_colors(errors: npt.NDArray[Any]) -> Image:
    """FLIP, 0..1, from black over red to yellow; the root of the error, so that small ones show."""
    scaled = (np.sqrt(np.clip(errors, 0.0, 1.0)) * 255.0 + 0.5).astype(np.uint8)
    colors = cv2.applyColorMap(scaled, cv2.COLORMAP_INFERNO)
    return np.ascontiguousarray(colors[..., ::-1], dtype=np.uint8)


def bounding_box(region: npt.NDArray[np.bool_], shape: tuple[int, int]) -> Box:
    """Where a region lies, a little wider, in the shape of a crop and inside the picture; all of it if it is empty."""
    height, width = shape
    rows, columns = np.nonzero(region)
    if len(rows) == 0:
        return slice(0, height), slice(0, width)
    # Outliers of a few pixels would make any box the whole picture.
    top, bottom = np.quantile(rows, [0.01, 0.99])
    left, right = np.quantile(columns, [0.01, 0.99])
    high = max(bottom - top, (right - left) / CROP_ASPECT, 60.0) * 1.15 + 8.0
    high = min(high, height, width / CROP_ASPECT)
    wide = high * CROP_ASPECT
    y = min(max(0.5 * (top + bottom) - 0.5 * high, 0.0), height - high)
    x = min(max(0.5 * (left + right) - 0.5 * wide, 0.0), width - wide)
    return slice(int(y), math.ceil(y + high)), slice(int(x), math.ceil(x + wide))


def crop(image: Image, box: Box) -> Image:
    """Part of a picture, scaled up in whole steps so that its pixels stay visible."""
    part = image[box]
    times = max(1, round(CROP_SIDE / part.shape[1]))
    return np.ascontiguousarray(np.kron(part, np.ones((times, times, 1), np.uint8)))


def figure(image: Image, caption: str, *, photo: bool = True) -> str:
    """A picture and what it is; the caption is HTML."""
    plain = html.escape(caption.replace("<b>", "").replace("</b>", ""), quote=True)
    return (
        f'<figure><img src="{data_uri(image, photo=photo)}" alt="{plain}"><figcaption>{caption}</figcaption></figure>'
    )


def strip(columns: Sequence[tuple[str, Image]], reference: Image | None, box: Box) -> str:
    """Crops side by side, and below each its error against ``reference``."""
    style = f'<div class="row" style="grid-template-columns:repeat({len(columns)},minmax(0,1fr))">'
    parts = [style, *(figure(crop(image, box), f"<b>{html.escape(label)}</b>") for label, image in columns)]
    if reference is not None:
        for _, image in columns:
            if image is reference:
                parts.append("<figure><figcaption>what the others are compared with</figcaption></figure>")
                continue
            errors = flip_map(reference, image)
            text = f"FLIP {errors[box].mean():.4f} here, {errors.mean():.4f} overall"
            parts.append(figure(crop(error_colors(errors), box), text, photo=False))
    return "".join([*parts, "</div>"])


# --------------------------------------------------------------------------------------------------------------- charts


def _ticks(low: float, high: float) -> list[float]:
    """Round values of a logarithmic axis: 1, 2 and 5 times powers of ten, thinned to at most eight."""
    tens = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    values = [m * 10.0**e for e in tens for m in (1, 2, 5)]
    inside = [value for value in values if low <= value <= high]
    return inside if len(inside) <= 8 else [10.0**e for e in tens if low <= 10.0**e <= high]


def scatter(points: Sequence[tuple[str, float, float, bool]], x_title: str, y_title: str) -> str:
    """A chart of cost against error, cost logarithmic: points that nothing dominates are filled and joined.

    Args:
        points: Label, cost, error, whether something dominates it.
        x_title: What the cost is.
        y_title: What the error is.
    """
    width, height = PLOT
    left, right, top, bottom = MARGIN
    costs = [max(cost, 1e-3) for _, cost, _, _ in points]
    low, high = min(costs) / 1.6, max(costs) * 2.2
    tall = max(max(error for _, _, error, _ in points) * 1.12, 1e-6)

    def x(cost: float) -> float:
        share = math.log(max(cost, 1e-3) / low) / math.log(high / low)
        return left + share * (width - left - right)

    def y(error: float) -> float:
        return top + (1.0 - error / tall) * (height - top - bottom)

    step = 10.0 ** math.floor(math.log10(tall))
    step *= next(share for share in (0.2, 0.5, 1.0, 2.0) if tall / (share * step) <= 6.0)
    title = f"{html.escape(y_title)} over {html.escape(x_title)}"
    parts = [f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{title}">']
    for count in range(int(tall / step) + 1):
        at = y(count * step)
        parts.append(f'<line class="axis" x1="{left}" x2="{width - right}" y1="{at:.1f}" y2="{at:.1f}"/>')
        parts.append(f'<text x="{left - 8}" y="{at + 4:.1f}" text-anchor="end">{count * step:.3g}</text>')
    for value in _ticks(low, high):
        parts.append(f'<text x="{x(value):.1f}" y="{height - bottom + 18}" text-anchor="middle">{value:g}</text>')
    parts.append(f'<text x="{width - right}" y="{height - 6}" text-anchor="end">{html.escape(x_title)}</text>')
    parts.append(f'<text x="{left - 46}" y="12">{html.escape(y_title)}</text>')
    front = sorted((cost, error) for _, cost, error, out in points if not out)
    path = " ".join(f"{'M' if k == 0 else 'L'}{x(c):.1f} {y(e):.1f}" for k, (c, e) in enumerate(front))
    parts.append(f'<path class="front" d="{path}"/>')
    taken: list[tuple[float, float]] = []
    for label, cost, error, out in sorted(points, key=lambda point: point[1]):
        px, py = x(cost), y(error)
        parts.append(
            f'<circle class="{"off" if out else "on"}" cx="{px:.1f}" cy="{py:.1f}" r="5">'
            f"<title>{html.escape(label)}: {cost:.3g} ms, {error:.4f}</title></circle>"
        )
        ty = py - 9.0
        while any(abs(ty - other) < 13.0 and abs(px - ox) < 84.0 for ox, other in taken):
            ty += 13.0 if ty >= py else -13.0
            if ty < top:
                ty = py + 18.0
        taken.append((px, ty))
        anchor = "end" if px > width - 110 else "start" if px < left + 40 else "middle"
        style = "" if out else ' class="label"'
        parts.append(f'<text{style} x="{px:.1f}" y="{ty:.1f}" text-anchor="{anchor}">{html.escape(label)}</text>')
    return "".join([*parts, "</svg>"])


# --------------------------------------------------------------------------------------------------------------- tables


def table(head: Sequence[str], rows: Iterable[tuple[Sequence[str], bool]]) -> str:
    """A table; rows come with whether they are set back."""
    top = "".join(f"<th>{html.escape(cell)}</th>" for cell in head)
    body = "".join(
        ('<tr class="out">' if out else "<tr>") + "".join(f"<td>{html.escape(cell)}</td>" for cell in cells) + "</tr>"
        for cells, out in rows
    )
    return f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"


def _knob_table(rows: Sequence[Row]) -> str:
    def cells(row: Row) -> list[str]:
        error = row.stage_error
        numbers = (
            ["–", "–", "–"]
            if error is None
            else [f"{error.relative_rmse:.2%}", f"{error.worst:.2f}", f"{error.energy_drift:+.2%}"]
        )
        return [row.rung, f"{row.milliseconds:.2f}", f"{row.flip:.4f}", *numbers]

    head = ("rung", "ms", "FLIP", "rel. RMSE", "worst", "drift")
    return table(head, ((cells(row), row.dominated) for row in rows))


def _comparisons(rows: Sequence[Row]) -> str:
    """The cheapest rung, normally the paper's, against the best of equal time and the cheapest of equal error."""
    lines = []
    for row in rows:
        faster = [other for other in rows if other.milliseconds <= row.milliseconds and other.flip < 0.99 * row.flip]
        if faster:
            best = min(faster, key=lambda other: other.flip)
            lines.append(f"In the time of {row.rung}, {best.rung} errs {1 - best.flip / row.flip:.0%} less.")
        same = [other for other in rows if other.flip <= row.flip and other.milliseconds < 0.95 * row.milliseconds]
        if same:
            best = min(same, key=lambda other: other.milliseconds)
            lines.append(f"For the error of {row.rung}, {best.rung} takes {best.milliseconds / row.milliseconds:.0%}.")
    return " ".join(dict.fromkeys(lines)) or "No rung is beaten by more than the measurement can tell."


# ------------------------------------------------------------------------------------------------------------- sections


def _whole_section(report: CaseReport) -> str:
    index = report.case.shown[-1]
    camera = report.case.frames[index].image
    box = bounding_box(report.region, camera.shape[:2])
    by_label = {whole.label: whole for whole in report.wholes}
    last = ("truth" if report.case.truth else "reference", report.reference[index])
    shown = ("paper", "ours in the paper's time", "medium", "high")
    pictures = [(label, by_label[label].images[index]) for label in shown if label in by_label]
    truth = "the truth" if report.case.truth else "the preset <i>reference</i>"
    points = [(whole.label, whole.milliseconds, whole.flip, _beaten(whole, report.wholes)) for whole in report.wholes]
    rows = (
        ([whole.label, f"{whole.milliseconds:.2f}", f"{whole.flip:.4f}"], _beaten(whole, report.wholes))
        for whole in report.wholes
    )
    return "".join(
        [
            f"<p>{len(report.case.frames)} frames of {camera.shape[1]}x{camera.shape[0]}, compared with {truth}. "
            "FLIP is summed over the picture and divided by the pixels that anything virtual changes.</p>",
            strip([("camera", camera), *pictures, last], last[1], box),
            '<div class="split"><div class="card">',
            scatter(points, "milliseconds per frame", "FLIP"),
            '</div><div class="card">',
            table(("as a whole", "ms", "FLIP"), rows),
            f"<p class=soft>{html.escape(_whole_words(by_label))}</p></div></div>",
        ]
    )


def _beaten(whole: Whole, others: Sequence[Whole]) -> bool:
    return any(
        other.milliseconds <= whole.milliseconds and other.flip <= whole.flip and other is not whole for other in others
    )


def _whole_words(by_label: Mapping[str, Whole]) -> str:
    """Equal time and equal error, in words."""
    paper = by_label.get("paper")
    lines = []
    if paper is not None and "ours in the paper's time" in by_label:
        ours = by_label["ours in the paper's time"]
        lines.append(
            f"Equal time: with {paper.milliseconds:.1f} ms as budget, {ours.milliseconds:.1f} ms and "
            f"{1 - ours.flip / paper.flip:.0%} less error: {_settings(ours)}."
        )
    if paper is not None and "ours at the paper's error" in by_label:
        ours = by_label["ours at the paper's error"]
        lines.append(
            f"Equal error: {ours.flip:.4f} against {paper.flip:.4f} in {ours.milliseconds / paper.milliseconds:.0%} "
            f"of the time: {_settings(ours)}."
        )
    return " ".join(lines)


def _settings(whole: Whole) -> str:
    return ", ".join(f"{knob} {rung}" for knob, rung in whole.settings.items())


def _knob_section(report: CaseReport, rows: Sequence[Row]) -> str:
    knob = rows[0].knob
    index = report.case.shown[-1]
    pictures = [(row.rung, report.pictures[knob, row.rung]) for row in rows]
    reference = report.reference[index] if report.case.truth else pictures[-1][1]
    # Where the rungs differ is what there is to see.
    difference = np.abs(pictures[0][1].astype(int) - pictures[-1][1].astype(int)).max(-1)
    box = bounding_box(difference > max(4, int(0.3 * difference.max())), difference.shape)
    columns = [*pictures, ("truth", reference)] if report.case.truth else pictures
    points = [(row.rung, row.milliseconds, row.excess, row.dominated) for row in rows]
    return "".join(
        [
            f"<h3>{html.escape(knob.replace('_', ' '))}</h3>",
            '<div class="split"><div class="card">',
            scatter(points, "milliseconds of its stages", f"FLIP against {rows[0].against}, above the best rung's"),
            '</div><div class="card">',
            _knob_table(rows),
            f"<p class=soft>{html.escape(_comparisons(rows))}</p></div></div>",
            strip(columns, reference, box),
        ]
    )


def _figure_section(shown: Figure) -> str:
    image = shown.columns[0][1]
    picked = shown.region if shown.region is not None else np.zeros(image.shape[:2], bool)
    return (
        f"<h3>{html.escape(shown.title)}</h3><p>{html.escape(shown.text)}</p>"
        f"{strip(shown.columns, shown.reference, bounding_box(picked, image.shape[:2]))}"
    )


def render(
    reports: Sequence[CaseReport], figures: Sequence[Figure], made: Mapping[str, Any], extra: Sequence[Any] = ()
) -> str:
    """The whole page.

    Args:
        reports: One per case.
        figures: The paper's figures, redone.
        made: On what it was measured: ``device`` and ``warp``.
        extra: Lines of the bench of arithmetic.
    """
    anchors = [(f"case{index}", report) for index, report in enumerate(reports)]
    ramp = error_colors(np.linspace(0.0, 1.0, 64)[None] ** 2)
    parts = [
        '<!doctype html><html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width,initial-scale=1"><title>What accuracy costs</title>',
        f"<style>{_STYLE}</style></head><body><main><h1>What accuracy costs</h1>",
        f'<p class="soft">Measured on {html.escape(str(made["device"]))} with Warp {html.escape(str(made["warp"]))}. '
        "Every stage has rungs, from the paper's way to brute force; here is what each errs and what it takes. "
        "Rungs that another beats in both are hollow and grey.</p>",
        f'<p class="soft">Error maps: 0 <img class="scale" alt="" src="{data_uri(ramp, photo=False)}"> 1 (FLIP)</p>',
        "<nav>",
        *(f'<a href="#{anchor}">{html.escape(report.case.name)}</a>' for anchor, report in anchors),
        '<a href="#figures">The paper\'s figures</a>' if figures else "",
        "</nav>",
    ]
    for anchor, report in anchors:
        parts.append(f'<section id="{anchor}"><h2>{html.escape(report.case.name)}</h2>')
        parts.append(_whole_section(report))
        for _, rows in itertools.groupby(report.rows, lambda row: row.knob):
            parts.append(_knob_section(report, list(rows)))
        parts.append("</section>")
    if figures:
        parts.append('<section id="figures"><h2>The paper\'s figures, redone</h2>')
        parts += [_figure_section(shown) for shown in figures]
        parts.append("</section>")
    parts.append("</main></body></html>\n")
    return "".join(parts)
