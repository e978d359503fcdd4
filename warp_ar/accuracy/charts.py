"""Charts of cost against error, as SVG that stands inside a page and takes its colours."""

from __future__ import annotations

import dataclasses
import html
import io
import itertools
import re
import zlib
from collections.abc import Sequence
from typing import Any

import numpy.typing as npt

from warp_ar.errors import UsageError

SIZE = (5.6, 3.2)
"""Width and height of a chart, inches of 100 pixels."""
SMALL = (4.0, 2.8)
"""Of one among many."""
_DPI = 100
_COLORS = {
    "soft": "#5c5f61",
    "ink": "#1b1c1d",
    "line": "#dcdcd1",
    "card": "#fffff1",
    "mark": "#2f6fd1",
    "other": "#9a9c91",
    "warm": "#c25711",
}
"""Colours by the page's names for them. The page has a dark form: in the SVG each becomes ``var(--NAME)``."""
_FONT = 9.0
_PLACES = ((0, 8), (0, -15), (9, -4), (-9, -4), (12, 10), (-12, 10), (12, -16), (-12, -16), (14, 22), (-14, 22))
"""Offsets of a label from its point, in points: those to the right begin there, those to the left end there."""


@dataclasses.dataclass(frozen=True)
class Point:
    """One choice in a chart."""

    label: str
    milliseconds: float
    error: float
    dominated: bool
    """Another point costs no more and errs no more."""


def require_plots() -> None:
    """Check that charts can be drawn.

    Raises:
        UsageError: The package matplotlib is not installed.
    """
    try:
        import matplotlib  # noqa: F401  (only pages need it)
    except ImportError as error:
        raise UsageError('charts need the package matplotlib: pip install "warp-ar[tradeoff]"') from error


def scatter(
    points: Sequence[Point],
    x_title: str,
    y_title: str,
    limit: float | None = None,
    size: tuple[float, float] = SIZE,
) -> str:
    """A chart of cost, logarithmic, against error: the Pareto front is filled and joined.

    Args:
        points: What was measured.
        x_title: What the cost is.
        y_title: What the error is.
        limit: A cost to mark, in milliseconds: that of a frame at 30 frames per second.
        size: Width and height in inches of 100 pixels.
    """
    require_plots()
    from matplotlib.figure import Figure

    drawing = Figure(size, dpi=_DPI, layout="constrained")
    axes = drawing.add_subplot()
    _dress(axes, x_title, y_title)
    costs = [max(point.milliseconds, 1e-3) for point in points]
    axes.set_xscale("log")
    axes.set_xlim(min(costs) / 1.6, max(costs) * 2.2)
    axes.set_ylim(0.0, max(*(point.error for point in points), 1e-6) * 1.15)
    _label_ticks(axes)
    if limit is not None and axes.get_xlim()[0] < limit < axes.get_xlim()[1]:
        axes.axvline(limit, color=_COLORS["warm"], linestyle="--", linewidth=1.0)
        place: dict[str, Any] = {"xy": (limit, 1.0), "xycoords": ("data", "axes fraction"), "xytext": (3, 2)}
        axes.annotate("30 fps", **place, textcoords="offset points", color=_COLORS["warm"], fontsize=_FONT)
    front = sorted((cost, point.error) for cost, point in zip(costs, points, strict=True) if not point.dominated)
    if front:
        axes.plot(*zip(*front, strict=True), color=_COLORS["mark"], linewidth=1.6, alpha=0.55, zorder=1)
    for cost, point in zip(costs, points, strict=True):
        face, edge = ("card", "other") if point.dominated else ("mark", "mark")
        axes.plot(cost, point.error, "o", markersize=7, markerfacecolor=_COLORS[face], markeredgecolor=_COLORS[edge])
    _label_points(drawing, axes, costs, points)
    return to_svg(drawing, f"{y_title} over {x_title}", _spoken(points))


def lines(
    series: Sequence[tuple[str, npt.ArrayLike, npt.ArrayLike]],
    x_title: str,
    y_title: str,
    size: tuple[float, float] = SIZE,
) -> str:
    """A chart of several curves, named in a legend.

    Args:
        series: Name, x and y of each curve.
        x_title: What x is.
        y_title: What y is.
        size: Width and height in inches of 100 pixels.
    """
    require_plots()
    from matplotlib.figure import Figure

    drawing = Figure(size, dpi=_DPI, layout="constrained")
    axes = drawing.add_subplot()
    _dress(axes, x_title, y_title)
    looks = itertools.cycle(
        itertools.product(("-", "--", ":"), (_COLORS[name] for name in ("ink", "mark", "warm", "other")))
    )
    for (name, x, y), (style, color) in zip(series, looks, strict=False):
        axes.plot(x, y, style, color=color, linewidth=1.5, label=name)
    axes.legend(frameon=False, fontsize=_FONT, labelcolor=_COLORS["soft"])
    return to_svg(drawing, f"{y_title} over {x_title}", ", ".join(name for name, _, _ in series))


def _dress(axes: Any, x_title: str, y_title: str) -> None:
    """Axes, grid and titles in the page's colours."""
    axes.set_facecolor("none")
    axes.grid(axis="y", color=_COLORS["line"], linewidth=0.8)
    axes.set_axisbelow(True)
    for name, spine in axes.spines.items():
        spine.set_visible(name == "bottom")
        spine.set_color(_COLORS["line"])
    axes.tick_params(which="both", color=_COLORS["line"], labelcolor=_COLORS["soft"], labelsize=_FONT)
    axes.set_xlabel(f"{x_title} →", loc="right", color=_COLORS["soft"], fontsize=_FONT)
    axes.set_title(f"↑ {y_title}", loc="left", x=0.0, color=_COLORS["soft"], fontsize=_FONT, pad=14)


def _label_ticks(axes: Any) -> None:
    """Plain numbers at 1, 2 and 5 times powers of ten, or at those powers where there are many."""
    from matplotlib import ticker

    low, high = axes.get_xlim()
    steps = (1.0, 2.0, 5.0) if high / low < 300.0 else (1.0,)
    axes.xaxis.set_major_locator(ticker.LogLocator(subs=steps, numticks=20))
    axes.xaxis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_locator(ticker.NullLocator())
    axes.yaxis.set_major_locator(ticker.MaxNLocator(6))


def _label_points(drawing: Any, axes: Any, costs: Sequence[float], points: Sequence[Point]) -> None:
    """Name every point beside it, where that hides least of points and of other names."""
    from matplotlib.transforms import Bbox

    drawing.canvas.draw()
    spots = axes.transData.transform(list(zip(costs, (point.error for point in points), strict=True)))
    taken = [Bbox.from_bounds(x - 6.0, y - 6.0, 12.0, 12.0) for x, y in spots]
    page = drawing.bbox.padded(-2.0)
    for point, cost in sorted(zip(points, costs, strict=True), key=lambda item: item[1]):
        color = _COLORS["soft" if point.dominated else "ink"]
        best: tuple[float, Any, Any] | None = None
        for dx, dy in _PLACES:
            align = "center" if dx == 0 else "left" if dx > 0 else "right"
            place: dict[str, Any] = {"xytext": (dx, dy), "textcoords": "offset points", "ha": align}
            name = axes.annotate(point.label, (cost, point.error), **place, color=color, fontsize=_FONT)
            box = name.get_window_extent()
            hidden = sum(_shared_area(box, other) for other in taken) + box.width * box.height
            hidden -= _shared_area(box, page)
            if best is None or hidden < best[0] - 1e-6:
                if best is not None:
                    best[1].remove()
                best = hidden, name, box
            else:
                name.remove()
            if best[0] <= 1e-6:
                break
        assert best is not None
        taken.append(best[2])


def _shared_area(a: Any, b: Any) -> float:
    """Area that two boxes share."""
    wide = min(a.x1, b.x1) - max(a.x0, b.x0)
    high = min(a.y1, b.y1) - max(a.y0, b.y0)
    return float(max(wide, 0.0) * max(high, 0.0))


def _spoken(points: Sequence[Point]) -> str:
    """The chart in words, for those who do not see it."""
    return "; ".join(f"{point.label}: {point.milliseconds:.3g} ms, {point.error:.4f}" for point in points)


def to_svg(drawing: Any, title: str, description: str) -> str:
    """A drawing as SVG for the inside of a page: text stays text, colours are the page's, ids are the drawing's own."""
    import matplotlib

    file = io.StringIO()
    none = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": title + description}):
        drawing.savefig(file, format="svg", transparent=True, metadata=none)
    svg = file.getvalue()
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg[svg.index("<svg ") :], flags=re.S)
    svg = re.sub(r'(<svg [^>]*?) width="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r'(<svg [^>]*?)height="[^"]*" ', r"\1", svg, count=1)
    # Hex ids are the drawing's own; inherited fonts are the page's.
    salt = f"c{zlib.crc32((title + description).encode()):x}"
    svg = re.sub(r'((?:id="|href="#|url\(#))', rf"\g<1>{salt}", svg)
    svg = re.sub(r"font: ([\d.]+px) [^;\"]*", r"font-size: \1", svg)
    for name, color in _COLORS.items():
        svg = svg.replace(color, f"var(--{name})")
    label = html.escape(f"{title}: {description}", quote=True)
    return svg.replace("<svg ", f'<svg role="img" aria-label="{label}" ', 1).strip()


_DARK = {"soft": "#a9acb1", "ink": "#ececea", "line": "#303236", "card": "#1c1e21", "mark": "#7aa7ff"}


def stand_alone(svg: str) -> str:
    """A chart as a file of its own, with the colours that the page would give it."""
    light = ";".join(f"--{name}:{color}" for name, color in (_COLORS | {"card": "#ffffff"}).items())
    dark = ";".join(f"--{name}:{color}" for name, color in _DARK.items())
    style = (
        f"<style>svg{{{light};background:var(--card);font-family:sans-serif}}"
        f"@media(prefers-color-scheme:dark){{svg{{{dark}}}}}</style>"
    )
    start = svg.index(">") + 1
    return svg[:start] + style + svg[start:] + "\n"
