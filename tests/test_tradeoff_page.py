"""The page: one file that needs nothing else."""

from __future__ import annotations

import base64
import dataclasses
import html.parser
import re

import pytest

from tests.accuracy_rig import case, frames, report  # noqa: F401  (fixtures)
from warp_ar.accuracy import case_report, tradeoff_page

pytest.importorskip("flip_evaluator")
pytest.importorskip("matplotlib")


class Checker(html.parser.HTMLParser):
    """Every tag that opens closes, in order."""

    VOID = ("meta", "img")

    def __init__(self):
        super().__init__()
        self.open: list[str] = []
        self.images: list[str] = []

    def handle_starttag(self, tag, attrs):
        if tag == "img":
            self.images.append(dict(attrs)["src"])
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        pass

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_is_whole_and_needs_nothing_else(report):
    page = tradeoff_page.render([report], {"device": "this <one>", "warp": "1"})
    checker = Checker()
    checker.feed(page)
    assert checker.open == []
    assert "&lt;made&gt; &amp; so on" in page
    assert "this &lt;one&gt;" in page
    assert not re.search(r"""(src|href)=["'](?!data:|#)""", page)
    assert "<script" not in page
    assert len(checker.images) > 5
    for source in checker.images:
        code = re.fullmatch(r"data:image/webp;base64,(.+)", source).group(1)
        assert base64.b64decode(code)[:4] == b"RIFF"


def whole(label, flip, over):
    return case_report.Whole(label, 10.0 * over, flip, {"irradiance": "sh2"}, {}, over)


@pytest.mark.parametrize(
    ("over", "flip", "expected"),
    [
        (0.9, 0.2, ("In the paper's time (0.90x; 9.0 ms,", "33% less error", "At the paper's error or less (0.200,")),
        (
            1.2,
            0.4,
            ("Nearest to the paper's time, but longer (1.20x;", "33% more", "paper's error, above it (0.400,"),
        ),
    ],
)
def test_words_say_what_the_table_says(over, flip, expected):
    """What was sought is not claimed where it was not found."""
    ours = [whole(label, flip, over) for label in (case_report.SAME_TIME, case_report.SAME_ERROR)]
    words = tradeoff_page._whole_words([whole("paper", 0.3, 1.0), whole("high", 0.1, 9.5), *ours], brief=True)
    for text in (*expected, f"{over:.2f}x the paper's time", "High: 67% less error in 9.50x the time."):
        assert text in words


def test_no_method_is_called_optimal_beside_one_that_is_beaten(report):
    rows = [dataclasses.replace(row, error=0.1, milliseconds=1.0) for row in report.rows]
    assert "Pareto-optimal" in tradeoff_page._comparisons(rows)
    assert "Pareto-optimal" not in tradeoff_page._comparisons([rows[0], dataclasses.replace(rows[1], dominated=True)])
