"""The page: one file that needs nothing else."""

from __future__ import annotations

import base64
import html.parser
import re

import pytest

from tests.accuracy_rig import case, frames, report  # noqa: F401  (fixtures)
from warp_ar.accuracy import figures, tradeoff_page

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
    camera = report.case.frames[-1].image
    shown = figures.Figure("Figure 7", "text", (("camera", camera), ("ours", camera)), camera, None)
    page = tradeoff_page.render([report], [shown], {"device": "this <one>", "warp": "1"})
    checker = Checker()
    checker.feed(page)
    assert checker.open == []
    assert "&lt;made&gt; &amp; so on" in page
    assert "this &lt;one&gt;" in page
    assert not re.search(r"""(src|href)=["'](?!data:|#)""", page)
    assert "<script" not in page
    assert len(checker.images) > 10
    for source in checker.images:
        code = re.fullmatch(r"data:image/webp;base64,(.+)", source).group(1)
        assert base64.b64decode(code)[:4] == b"RIFF"
