"""The command."""

from __future__ import annotations

import base64
import html.parser
import json
import re

import pytest
from PIL import Image

from bench import paper_figures
from tests.accuracy_rig import case, frames, report, setting  # noqa: F401  (fixtures)
from warp_ar import paper, tradeoff
from warp_ar.accuracy import tradeoff_page
from warp_ar.command_line import EXIT_DONE, EXIT_FAILED
from warp_ar.signature import is_signed

pytestmark = pytest.mark.slow

pytest.importorskip("flip_evaluator")
pytest.importorskip("matplotlib")


def test_command_writes_all_three(tmp_path, monkeypatch, capsys, device):
    monkeypatch.setattr(tradeoff, "RUNS", ("low",))
    arguments = ["darken", "--stage", "expose", "--frames", "2", "--shrink", "4", "--device", device]
    assert tradeoff.main([*arguments, "--out", str(tmp_path / "out")]) == EXIT_DONE
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "tradeoff.html",
        "tradeoff.jsonl",
        "cost_table.json",
    }
    lines = (tmp_path / "out" / "tradeoff.jsonl").read_text().splitlines()
    methods = list(setting("expose").methods)
    assert [json.loads(line)["method"] for line in lines[: len(methods)]] == methods
    shown = capsys.readouterr().out
    assert "expose" in shown
    assert "darken: presets" in shown
    assert all(is_signed(path) for path in (tmp_path / "out").iterdir())


def no_measurement(*_):
    raise AssertionError("measured before its files were looked at")


def test_nothing_of_somebody_elses_is_overwritten(tmp_path, monkeypatch, capsys, device):
    (tmp_path / "presets.json").write_text("mine")
    monkeypatch.setattr(tradeoff, "measure_presets", no_measurement)
    assert tradeoff.main(["darken", "--presets", "--device", device, "--out", str(tmp_path)]) == EXIT_FAILED
    assert "presets.json is there, and this program did not write it" in capsys.readouterr().err
    assert (tmp_path / "presets.json").read_text() == "mine"


def test_presets_alone(tmp_path, device):
    arguments = ["darken", "--presets", "--only", "paper,low", "--frames", "2", "--shrink", "4", "--device", device]
    assert tradeoff.main([*arguments, "--out", str(tmp_path)]) == EXIT_DONE
    assert {path.name for path in tmp_path.iterdir()} == {"presets.json", "tradeoff.jsonl"}
    listed = json.loads((tmp_path / "presets.json").read_text())
    assert listed["made"]["against"] == "truth"
    assert set(listed["presets"]) == {"darken"}
    assert set(listed["presets"]["darken"]) == {"paper", "low"}
    assert all(0.0 < whole["error"] < 1.0 and whole["ms"] > 0.0 for whole in listed["presets"]["darken"].values())


# --- The page: one file that needs nothing else -----------------------------------------------------------------------


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


# --- The command that makes the paper's figures -----------------------------------------------------------------------


def test_a_figure_is_a_picture_numbers_and_a_plot(tmp_path, monkeypatch, capsys, device):
    monkeypatch.setattr(paper_figures, "OURS", ("low",))
    out = tmp_path / "paper"
    arguments = ["7", "--frames", "2", "--shrink", "4", "--device", device, "--out", str(out)]
    assert paper.main(arguments) == EXIT_DONE
    assert {path.name for path in out.iterdir()} == {"figure7.webp", "figure7.svg", "figures.md"}
    text = (out / "figures.md").read_text()
    assert text.startswith("<!-- warp_ar -->\n\n## Figure 7: ")
    assert "](paper/figure7.webp)" in text
    assert "| quality | ms per frame | FLIP to the truth | error kept |" in text
    assert "Figure 7" in capsys.readouterr().out
    assert "<svg " in (out / "figure7.svg").read_text()
    assert all(is_signed(path) for path in out.iterdir())
    picture = Image.open(out / "figure7.webp").convert("RGB")
    monkeypatch.setattr(paper, "write_figure", None)  # nothing is made where it may not be written
    picture.save(out / "figure7.webp", quality=50)
    kept = (out / "figure7.webp").read_bytes()
    assert paper.main(arguments) == EXIT_FAILED
    assert "figure7.webp is there, and this program did not write it" in capsys.readouterr().err
    assert (out / "figure7.webp").read_bytes() == kept
