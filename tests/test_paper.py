"""The command that makes the paper's figures."""

from __future__ import annotations

import pytest
from PIL import Image

from bench import paper_figures
from warp_ar import paper
from warp_ar.command_line import EXIT_DONE, EXIT_FAILED, EXIT_USAGE
from warp_ar.signature import is_signed

pytest.importorskip("flip_evaluator")
pytest.importorskip("matplotlib")


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
    assert "--mark:" in (out / "figure7.svg").read_text()
    assert all(is_signed(path) for path in out.iterdir())
    picture = Image.open(out / "figure7.webp").convert("RGB")
    monkeypatch.setattr(paper, "write_figure", None)  # nothing is made where it may not be written
    picture.save(out / "figure7.webp", quality=50)
    kept = (out / "figure7.webp").read_bytes()
    assert paper.main(arguments) == EXIT_FAILED
    assert "figure7.webp is there, and this program did not write it" in capsys.readouterr().err
    assert (out / "figure7.webp").read_bytes() == kept


def test_readings_are_a_table(monkeypatch, capsys, device):
    monkeypatch.setattr(paper, "READING_SCENES", ("darken",))
    monkeypatch.setattr(paper_figures, "READING_SCENES", ("darken",))
    assert paper.main(["readings", "--frames", "2", "--shrink", "4", "--device", device]) == EXIT_DONE
    printed = capsys.readouterr().out
    assert "Readings of the open text" in printed
    assert "clamp" in printed


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["2"], "figure 2: expected 1, 3, 4"),
        (["1", "--frames", "0"], "--frames 0: expected 1 or more"),
        (["1", "--shrink", "0"], "--shrink 0: expected 1 or more"),
    ],
)
def test_bad_usage_is_one_line(arguments, message, capsys):
    assert paper.main(arguments) == EXIT_USAGE
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
