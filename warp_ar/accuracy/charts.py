"""Charts of cost against error, as SVG."""

from __future__ import annotations

import dataclasses
import html
import io
import itertools
from collections.abc import Sequence
from typing import Any

import numpy.typing as npt

from warp_ar.errors import import_extra

SIZE, SMALL = (5.6, 3.2), (4.0, 2.8)
"""Width and height of a large and of a small chart, in inches of 100 pixels."""
_COLORS = {
    "soft": "#5c5f61",
    "ink": "#1b1c1d",
    "line": "#dcdcd1",
    "card": "#ffffff",
    "mark": "#2f6fd1",
    "other": "#9a9c91",
    "warm": "#c25711",
}
"""Colours of the page."""
_FONT = 9.0


@dataclasses.dataclass(frozen=True)
class Point:
    """Point of a chart: a measured method or quality."""

    label: str
    milliseconds: float
    error: float
    """Error in FLIP."""
    dominated: bool
    """True if another point costs no more and has no larger error."""


def require_plots() -> None:
    """Check that charts can be drawn.

    Raises:
        UsageError: The package matplotlib is not installed.
    """
    import_extra("tradeoff", "charts need matplotlib", "matplotlib")


def scatter(
    points: Sequence[Point],
    x_title: str,
    y_title: str,
    limit: float | None = None,
    size: tuple[float, float] = SIZE,
) -> str:
    """Return a chart, as SVG, of error over the logarithm of cost; a line joins the Pareto-optimal points.

    Args:
        points: Measured methods or qualities.
        x_title: Name of the cost.
        y_title: Name of the error.
        limit: Cost in milliseconds of 30 frames per second, to mark it; None: it is not marked.
        size: Width and height in inches of 100 pixels.
    """
    drawing, axes = _axes(x_title, y_title, size)
    from matplotlib import ticker

    points = sorted(points, key=lambda point: point.milliseconds)
    costs = [max(point.milliseconds, 1e-3) for point in points]
    axes.set_xscale("log")
    axes.set_xlim(costs[0] / 1.6, costs[-1] * 2.2)
    axes.set_ylim(0.0, max(*(point.error for point in points), 1e-6) * 1.15)
    steps = (1.0, 2.0, 5.0) if costs[-1] / costs[0] < 100.0 else (1.0,)
    axes.xaxis.set_major_locator(ticker.LogLocator(subs=steps, numticks=20))
    axes.xaxis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_locator(ticker.NullLocator())
    if limit is not None and axes.get_xlim()[0] < limit < axes.get_xlim()[1]:
        axes.axvline(limit, color=_COLORS["warm"], linestyle="--", linewidth=1.0)
        place: dict[str, Any] = {"xy": (limit, 1.0), "xycoords": ("data", "axes fraction"), "xytext": (3, 2)}
        axes.annotate("30 fps", **place, textcoords="offset points", color=_COLORS["warm"], fontsize=_FONT)
    front = [(cost, point.error) for cost, point in zip(costs, points, strict=True) if not point.dominated]
    if front:
        axes.plot(*zip(*front, strict=True), color=_COLORS["mark"], linewidth=1.6, alpha=0.55, zorder=1)
    for number, (cost, point) in enumerate(zip(costs, points, strict=True)):
        face, edge = ("card", "other") if point.dominated else ("mark", "mark")
        axes.plot(cost, point.error, "o", markersize=7, markerfacecolor=_COLORS[face], markeredgecolor=_COLORS[edge])
        # Labels of neighbouring points alternate between above and below.
        below = bool(number % 2) and point.error > 0.2 * axes.get_ylim()[1]
        style = {"color": _COLORS["soft" if point.dominated else "ink"], "fontsize": _FONT, "ha": "center"}
        offset = (0, -15 if below else 8)
        axes.annotate(point.label, (cost, point.error), xytext=offset, textcoords="offset points", **style)
    spoken = "; ".join(f"{point.label}: {point.milliseconds:.3g} ms, {point.error:.4f}" for point in points)
    return _to_svg(drawing, f"{y_title} over {x_title}", spoken)


def lines(series: Sequence[tuple[str, npt.ArrayLike, npt.ArrayLike]], x_title: str, y_title: str) -> str:
    """Return a chart, as SVG, of several curves, each given by name, x and y, with a legend."""
    drawing, axes = _axes(x_title, y_title, SIZE)
    looks = itertools.cycle(
        itertools.product(("-", "--", ":"), (_COLORS[name] for name in ("ink", "mark", "warm", "other")))
    )
    for (name, x, y), (style, color) in zip(series, looks, strict=False):
        axes.plot(x, y, style, color=color, linewidth=1.5, label=name)
    axes.legend(frameon=False, fontsize=_FONT, labelcolor=_COLORS["soft"])
    return _to_svg(drawing, f"{y_title} over {x_title}", ", ".join(name for name, _, _ in series))


def _axes(x_title: str, y_title: str, size: tuple[float, float]) -> tuple[Any, Any]:
    """Return an empty figure and its axes."""
    require_plots()
    from matplotlib.figure import Figure

    drawing = Figure(size, dpi=100, layout="constrained")
    axes = drawing.add_subplot()
    axes.grid(axis="y", color=_COLORS["line"], linewidth=0.8)
    axes.set_axisbelow(True)
    for name, spine in axes.spines.items():
        spine.set_visible(name == "bottom")
        spine.set_color(_COLORS["line"])
    axes.tick_params(which="both", color=_COLORS["line"], labelcolor=_COLORS["soft"], labelsize=_FONT)
    axes.set_xlabel(f"{x_title} →", loc="right", color=_COLORS["soft"], fontsize=_FONT)
    axes.set_title(f"↑ {y_title}", loc="left", x=0.0, color=_COLORS["soft"], fontsize=_FONT, pad=14)
    return drawing, axes


def _to_svg(drawing: Any, title: str, description: str) -> str:
    """Return a figure as SVG for a file or a page; its text is not converted to outlines, and its ids are unique."""
    import matplotlib

    file = io.StringIO()
    none = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": title + description}):
        drawing.savefig(file, format="svg", metadata=none)
    svg = file.getvalue()
    label = html.escape(f"{title}: {description}", quote=True)
    return svg[svg.index("<svg ") :].replace("<svg ", f'<svg role="img" aria-label="{label}" ', 1)
