"""Progress with the time that is left."""

from __future__ import annotations

import io

from rich.console import Console

from warp_ar.accuracy.progress import WorkProgress, time_left


def test_time_left_is_the_mean_of_what_was_done() -> None:
    assert time_left(60.0, 2.0, 6.0) == "2:00 left"
    assert time_left(5.0, 0.0, 6.0) == "time left: not known yet"
    assert time_left(60.0, 7.0, 6.0) == "0:00 left"


def test_where_there_is_no_terminal_every_step_is_a_line() -> None:
    now = iter([0.0, 10.0, 40.0])
    text = io.StringIO()
    with WorkProgress(Console(file=text, width=100), 4.0, lambda: next(now)) as progress:
        progress.advance("first", 1.0)
        progress.advance("second", 1.0)
    lines = text.getvalue().splitlines()
    assert [line.split() for line in lines] == [
        ["25%", "0:30", "left", "first"],
        ["50%", "0:40", "left", "second"],
    ]
