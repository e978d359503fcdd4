"""Where a run stands as a page: one file that needs nothing else, or served anew at each look.

The page is drawn from the run's folder alone, by whoever can read it; the driver knows nothing of it. Served, it
answers on this machine only, and gives out nothing but itself and the run's logs.
"""

from __future__ import annotations

import functools
import html
import http.server
import json
import os
import time
import urllib.parse
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from warp_ar.errors import SinkError, UsageError, WarpArError, printable, reason
from warp_ar.farm.manifest import MANIFEST, parse_line
from warp_ar.farm.status import read_status, words_of_seconds
from warp_ar.files import write_whole

RECENT = 40
"""Finished jobs that are listed."""
MOST_FAILED = 500
"""Failed jobs that are listed."""
REFRESH_SECONDS = 3
"""After which a served page is asked for again."""
_TAIL_BYTES = 1 << 16
HOST = "127.0.0.1"

_STYLE = """
:root {
  --bg: #121417; --panel: #1a1d21; --raised: #23272d; --line: #2e333a; --text: #eceae5; --muted: #989fa8;
  --accent: #f0a63c; --bad: #ff6b5e; --good: #5ed39a; color-scheme: dark;
}
@media (prefers-color-scheme: light) {
  :root {
    --bg: #f3f1ec; --panel: #fffefb; --raised: #f0ede6; --line: #dcd7cc; --text: #1e2024; --muted: #62676f;
    --accent: #8a5200; --bad: #c0311f; --good: #16824f; color-scheme: light;
  }
}
* { box-sizing: border-box; }
body {
  margin: 0; background: var(--bg); color: var(--text); font-variant-numeric: tabular-nums;
  font: 14px/1.45 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", sans-serif;
}
header { padding: 10px 18px; border-bottom: 1px solid var(--line); background: var(--panel); }
main { max-width: 1100px; margin: 0 auto; padding: 16px 18px 40px; }
h1 { font-size: 16px; font-weight: 600; margin: 0; overflow-wrap: anywhere; }
h2 {
  font-size: 11.5px; letter-spacing: .07em; text-transform: uppercase; color: var(--muted); font-weight: 600;
  margin: 22px 0 6px;
}
p { margin: 4px 0; color: var(--muted); }
.state { color: var(--muted); } .state.on { color: var(--good); } .bad { color: var(--bad); }
progress { width: 100%; height: 8px; margin: 14px 0 2px; accent-color: var(--accent); }
dl { display: grid; grid-template-columns: repeat(auto-fit, minmax(130px, 1fr)); gap: 10px; margin: 12px 0 0; }
dl div { background: var(--panel); border: 1px solid var(--line); border-radius: 10px; padding: 8px 12px; }
dt { color: var(--muted); font-size: 12px; } dd { margin: 0; font-size: 20px; font-weight: 600; }
.scroll { overflow-x: auto; background: var(--panel); border: 1px solid var(--line); border-radius: 10px; }
table { border-collapse: collapse; width: 100%; min-width: 600px; }
th { text-align: left; color: var(--muted); font-weight: 500; font-size: 12px; }
th, td { padding: 6px 12px; border-bottom: 1px solid var(--line); vertical-align: top; overflow-wrap: anywhere; }
tr:last-child td { border-bottom: 0; }
.number { text-align: right; white-space: nowrap; } .bar { width: 22%; min-width: 90px; }
.bar span { display: block; height: 8px; margin-top: 6px; border-radius: 4px; background: var(--accent); }
a { color: var(--accent); } :focus-visible { outline: 2px solid var(--accent); outline-offset: 2px; }
"""


def status_page(folder: Path, link: Callable[[str], str | None], *, refresh: bool) -> str:
    """The page, as HTML.

    Args:
        folder: Of the run.
        link: Address of a log by its name, such as ``worker-0``; None where there is none.
        refresh: Whether the page asks for itself again and again.

    Raises:
        UsageError: There is no run.
        RunError: It cannot be read.
    """
    status = read_status(folder)
    progress = status["progress"]
    on = bool(status["running"])
    known, open_jobs = int(progress.get("jobs_known", 0)), int(progress.get("jobs_open", 0))
    told = "a driver is at work" if on else "no driver is at work"
    asked_again = f'<meta http-equiv="refresh" content="{REFRESH_SECONDS}">' if refresh else ""
    parts = [
        '<!doctype html><html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"{asked_again}<title>{_text(folder.name)}: farm</title><style>{_STYLE}</style></head><body>",
        f'<header><h1>{_text(folder)}</h1><div class="state{" on" if on else ""}">{told}, ',
        f"{time.strftime('%Y-%m-%d %H:%M:%S')}</div></header><main>",
        f'<progress max="{max(known, 1)}" value="{known - open_jobs}" aria-label="jobs done"></progress>',
        f"<p>{known - open_jobs} of {known} jobs of surveyed clips are done or have failed; "
        f"{progress.get('clips_surveyed', 0)} of {status['clips']} clips are surveyed</p>",
        _tiles(status),
        _workers(progress.get("workers", []) if on else [], link),
        _failures(status["failed"], link),
        _recent(folder, link),
        f"<p>{_text(status['version'])}</p></main></body></html>\n",
    ]
    return "".join(parts)


def _text(value: object) -> str:
    return html.escape(str(value))


def _tiles(status: dict[str, Any]) -> str:
    progress = status["progress"]
    left = progress.get("seconds_left") if status["running"] else None
    rate = sum(worker["fps"] for worker in progress.get("workers", []) if worker["job"]) if status["running"] else 0.0
    values = {
        "frames lit": f"{status['frames']:,}",
        "frames a second": f"{rate:.1f}",
        "written": _bytes(status["bytes"]),
        "time left": "-" if left is None else words_of_seconds(left),
        "jobs failed": f'<span class="bad">{len(status["failed"])}</span>' if status["failed"] else "0",
    }
    return "<dl>" + "".join(f"<div><dt>{name}</dt><dd>{value}</dd></div>" for name, value in values.items()) + "</dl>"


def _bytes(count: float) -> str:
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.0f} B" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} TB"


def _linked(name: str, link: Callable[[str], str | None]) -> str:
    address = link(name)
    return _text(name) if address is None else f'<a href="{html.escape(address)}">{_text(name)}</a>'


def _table(title: str, heads: Sequence[str], rows: Iterable[Sequence[str]], nothing: str) -> str:
    """A table under its title; heads that begin with # are of numbers, with | of bars."""
    lines = list(rows)
    if not lines:
        return f"<h2>{title}</h2><p>{nothing}</p>"
    kinds = [{"#": ' class="number"', "|": ' class="bar"'}.get(head[:1], "") for head in heads]
    top = "".join(f"<th{kind}>{head.lstrip('#|')}</th>" for head, kind in zip(heads, kinds, strict=True))
    body = "".join(
        "<tr>" + "".join(f"<td{kind}>{cell}</td>" for cell, kind in zip(row, kinds, strict=True)) + "</tr>"
        for row in lines
    )
    return (
        f'<h2>{title}</h2><div class="scroll"><table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'
    )


def _workers(workers: Sequence[dict[str, Any]], link: Callable[[str], str | None]) -> str:
    fastest = max((worker["fps"] for worker in workers), default=0.0) or 1.0

    def row(number: int, worker: dict[str, Any]) -> Sequence[str]:
        job = worker["job"]
        return (
            _linked(f"worker-{number}", link),
            _text(worker["device"]),
            _linked(job, link) if job else "waiting",
            str(worker["frames"]) if job else "",
            f"{worker['fps']:.1f}",
            f'<span style="width:{100 * worker["fps"] / fastest:.0f}%"></span>',
        )

    heads = ("worker", "device", "job", "#frame", "#frames/s", "|")
    return _table("Workers", heads, (row(n, w) for n, w in enumerate(workers)), "none is at work")


def _failures(failed: dict[str, str], link: Callable[[str], str | None]) -> str:
    rows = [(_linked(key, link), f'<span class="bad">{_text(why)}</span>') for key, why in sorted(failed.items())]
    more = f"<p>and {len(rows) - MOST_FAILED} more</p>" if len(rows) > MOST_FAILED else ""
    return _table("Failed", ("job", "reason"), rows[:MOST_FAILED], "nothing has failed") + more


def _recent(folder: Path, link: Callable[[str], str | None]) -> str:
    def row(told: dict[str, Any]) -> Sequence[str]:
        seconds, frames = float(told.get("seconds", 0.0)), int(told.get("frames") or told.get("length") or 0)
        return (
            _linked(told["job"], link),
            str(told.get("worker", "")),
            str(frames),
            f"{seconds:.1f}",
            f"{frames / seconds:.1f}" if seconds > 0.0 else "",
            _bytes(float(told.get("bytes", 0))),
        )

    heads = ("job", "#worker", "#frames", "#seconds", "#frames/s", "#written")
    return _table("Last done", heads, map(row, recent_jobs(folder)), "nothing yet")


def recent_jobs(folder: Path) -> list[dict[str, Any]]:
    """Lines of the manifest of the jobs that were done last, the newest first."""
    try:
        with open(folder / MANIFEST, "rb") as stream:
            size = stream.seek(0, os.SEEK_END)
            stream.seek(max(0, size - _TAIL_BYTES))
            lines = stream.read().split(b"\n")
    except OSError:
        return []
    found = []
    for line in reversed(lines if size <= _TAIL_BYTES else lines[1:]):
        try:
            told = parse_line(line)
        except ValueError:
            continue  # one that is being written
        if told.get("state") == "done":
            found.append(told)
        if len(found) == RECENT:
            break
    return found


def log_of(folder: Path, name: str) -> Path | None:
    """The log of a job or a worker; None where there is none, or the name leads out of the logs."""
    logs = (folder / "log").resolve()
    path = (logs / f"{name}.log").resolve()
    return path if path.is_relative_to(logs) and path.is_file() else None


def write_page(folder: Path, path: Path) -> None:
    """Write the page to a file, whose links lead to the logs from where it lies.

    Raises:
        SinkError: It cannot be written.
        UsageError: There is no run.
        RunError: It cannot be read.
    """

    def link(name: str) -> str | None:
        log = log_of(folder, name)
        return (
            None if log is None else urllib.parse.quote(os.path.relpath(log, path.resolve().parent).replace("\\", "/"))
        )

    page = status_page(folder, link, refresh=False)
    try:
        write_whole(path, page.encode())
    except OSError as error:
        raise SinkError(f"{path} cannot be written: {reason(error)}") from error


class _Handler(http.server.BaseHTTPRequestHandler):
    """Answers with the page, the status as JSON, or a log."""

    def __init__(self, folder: Path, *arguments: Any) -> None:
        self._folder = folder
        super().__init__(*arguments)

    def do_GET(self) -> None:
        """Answer."""
        host = self.headers.get("Host", "").rpartition(":")[0]
        if host not in (HOST, "localhost"):
            self.send_error(421, "expected this machine's own name")  # a page of elsewhere has it looked up
            return
        try:
            self._look_up()
        except WarpArError as error:
            self.send_error(500, printable(str(error)))

    def _look_up(self) -> None:
        path = urllib.parse.unquote(urllib.parse.urlsplit(self.path).path)
        if path == "/":
            page = status_page(self._folder, self._link, refresh=True)
            self._answer("text/html; charset=utf-8", page.encode())
        elif path == "/status.json":
            self._answer("application/json", json.dumps(read_status(self._folder)).encode())
        elif path.startswith("/log/") and (log := log_of(self._folder, path.removeprefix("/log/"))) is not None:
            self._answer("text/plain; charset=utf-8", log.read_bytes())
        else:
            self.send_error(404)

    def _link(self, name: str) -> str | None:
        return None if log_of(self._folder, name) is None else f"/log/{urllib.parse.quote(name)}"

    def _answer(self, kind: str, body: bytes) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", "default-src 'none'; style-src 'unsafe-inline'")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *arguments: Any) -> None:
        """Say nothing: who looks is no part of a run."""


def make_server(folder: Path, port: int) -> http.server.ThreadingHTTPServer:
    """A server of the page on this machine; ``serve_forever`` has it answer.

    Args:
        folder: Of the run.
        port: 0: any that is free.

    Raises:
        UsageError: There is no run, or the port is taken.
    """
    read_status(folder)
    try:
        return http.server.ThreadingHTTPServer((HOST, port), functools.partial(_Handler, folder))
    except OSError as error:
        raise UsageError(f"--serve {port}: {reason(error)}; name another port, or 0 for any that is free") from error
