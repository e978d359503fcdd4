"""Charts: all points inside, all named, in the page's colours."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree

import pytest

from warp_ar.accuracy import charts
from warp_ar.accuracy.charts import Point

pytest.importorskip("matplotlib")
SVG = "{http://www.w3.org/2000/svg}"


def parse(chart: str) -> ElementTree.Element:
    return ElementTree.fromstring(chart)


@pytest.mark.parametrize(
    "points",
    [
        [Point("one", 1.0, 0.0, False)],
        [Point("a", 0.0, 0.1, False), Point("b", 900.0, 1e-7, True)],
        [Point(f"method {k}", 1.0 + 0.01 * k, 0.1 - 0.01 * k, k > 2) for k in range(6)],
    ],
    ids=["one", "far apart", "close together"],
)
def test_scatter_holds_every_point_and_name(points: list[Point]) -> None:
    root = parse(charts.scatter(points, "ms", "error", 33.3))
    _, _, width, height = map(float, root.attrib["viewBox"].split())
    # Markers, and the marks of the axes, which stand inside as well.
    spots = {(float(node.attrib["x"]), float(node.attrib["y"])) for node in root.iter(f"{SVG}use")}
    assert len(spots) >= len({(point.milliseconds, point.error) for point in points})
    assert all(0.0 <= x <= width and 0.0 <= y <= height for x, y in spots)
    names = {node.text for node in root.iter(f"{SVG}text")}
    assert names >= {point.label for point in points}
    assert root.attrib["role"] == "img"
    assert all(point.label in root.attrib["aria-label"] for point in points)


def test_names_of_neighbours_do_not_lie_on_each_other() -> None:
    root = parse(charts.scatter([Point("one", 10.0, 0.1, False), Point("two", 10.1, 0.1, True)], "ms", "error"))
    places = {}
    for node in root.iter(f"{SVG}text"):
        numbers = re.findall(r"-?[0-9.]+", node.attrib["transform"])  # rotate(0 x y)
        places[node.text] = float(numbers[1]), float(numbers[2])
    (x, y), (u, v) = places["one"], places["two"]
    assert abs(x - u) > 20.0 or abs(y - v) > 8.0


def test_colours_are_the_pages_and_ids_differ() -> None:
    first, second = (charts.scatter([Point("a", ms, 0.1, False)], "ms", "error") for ms in (1.0, 2.0))
    for chart in (first, second):
        assert "var(--mark)" in chart
        assert "#2f6f" not in chart
        ids = set(re.findall(r'id="([^"]+)"', chart))
        used = set(re.findall(r'(?:href="#|url\(#)([^")]+)', chart))
        assert used <= ids
    assert not set(re.findall(r'id="([^"]+)"', first)) & set(re.findall(r'id="([^"]+)"', second))
    assert first == charts.scatter([Point("a", 1.0, 0.1, False)], "ms", "error")


def test_lines_are_named() -> None:
    chart = charts.lines([("truth", [0, 1], [0, 1]), ("paper", [0, 1], [1, 0])], "column", "brightness")
    assert {"truth", "paper"} <= {node.text for node in parse(chart).iter(f"{SVG}text")}
