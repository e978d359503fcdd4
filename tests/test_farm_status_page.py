"""The page that says where a run stands."""

from __future__ import annotations

import html.parser
import json
import threading
import time
import urllib.error
import urllib.parse
import urllib.request

import pytest

from warp_ar.farm.cli import main
from warp_ar.farm.manifest import locked
from warp_ar.farm.status import read_status
from warp_ar.farm.status_page import RECENT, log_of, make_server, recent_jobs, status_page, write_page


def write_run(folder, jobs=60):
    """A run that is being worked on: two workers, one failed job with a name and a reason that are no HTML."""
    (folder / "log" / "a").mkdir(parents=True)
    (folder / "run.json").write_text(json.dumps({"version": "warp_ar 1.0", "jobs": {"clip": [{}, {}]}}))
    lines = [{"state": "done", "job": "a/survey", "length": 600, "bytes": 1000, "seconds": 6.0, "worker": 0}]
    for number in range(jobs):
        key = f"a/segment-{number:06d}"
        lines.append({"state": "done", "job": key, "frames": 10, "bytes": 2000, "seconds": 0.5, "worker": number % 2})
        (folder / "log" / f"{key}.log").write_text("done\n")
    lines.append({"state": "failed", "job": "<b>/survey", "reason": "<script>alert(1)</script> is no video"})
    (folder / "manifest.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines) + '{"state": "do')
    (folder / "log" / "worker-0.log").write_text("kernels\n")
    workers = [
        {"device": "cuda:0", "job": "a/segment-000000", "frames": 7, "fps": 41.5},
        {"device": "cuda:1", "job": None, "frames": 0, "fps": 20.0},
    ]
    progress = {"time": time.time(), "ended": False, "workers": workers, "clips": 2, "clips_surveyed": 1}
    progress |= {"jobs_known": 80, "jobs_open": 20, "seconds_left": 300.0}
    (folder / "progress.json").write_text(json.dumps(progress))
    return folder


class Page(html.parser.HTMLParser):
    """Elements, addresses and text of a page."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.links, self.text = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.links += [value for name, value in attributes if name in ("href", "src")]

    def handle_data(self, data):
        self.text.append(data)


def test_the_page_says_what_stands_in_the_folder(tmp_path):
    run = write_run(tmp_path / "run")
    with locked(run):
        page = Page(status_page(run, lambda name: None, refresh=False))
    told = " ".join(page.text)
    for expected in ("60 of 80 jobs", "1 of 2 clips", "a driver is at work", "41.5", "cuda:1", "waiting", "5 min"):
        assert expected in told
    assert "600" in page.text, "frames lit"
    assert "121.0 kB" in page.text
    assert "<script>alert(1)</script> is no video" in page.text
    assert "script" not in page.tags
    assert not page.links
    assert told.count("a/segment-") == RECENT + 1


def test_links_of_a_file_lead_to_the_logs(tmp_path):
    run = write_run(tmp_path / "a run", jobs=3)
    (tmp_path / "pages").mkdir()
    with locked(run):
        assert main(["status", str(run), "--html", str(tmp_path / "pages/status.html")]) == 0
    page = Page((tmp_path / "pages/status.html").read_text())
    assert len(page.links) == 5  # worker 0, its job, and three jobs that are done
    for link in page.links:
        assert (tmp_path / "pages" / urllib.parse.unquote(link)).is_file(), link


def test_a_page_is_served_to_this_machine_with_logs_and_nothing_else(tmp_path):
    run = write_run(tmp_path / "run", jobs=2)
    (tmp_path / "secret.log").write_text("secret")
    with make_server(run, 0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        base = f"http://127.0.0.1:{server.server_port}"
        try:
            page = Page(urllib.request.urlopen(base, timeout=10).read().decode())
            for link in page.links:
                assert urllib.request.urlopen(base + link, timeout=10).status == 200
            assert json.load(urllib.request.urlopen(base + "/status.json", timeout=10))["frames"] == 20
            for wrong in ("/run.json", "/log/../secret", "/log/..%2F..%2Fsecret", "/log/none"):
                with pytest.raises(urllib.error.HTTPError, match="404"):
                    urllib.request.urlopen(base + wrong, timeout=10)
            with pytest.raises(urllib.error.HTTPError, match="421"):
                urllib.request.urlopen(
                    urllib.request.Request(base, headers={"Host": "elsewhere.example:80"}), timeout=10
                )
        finally:
            server.shutdown()


def test_lines_of_a_long_manifest_are_read_from_its_end(tmp_path):
    run = write_run(tmp_path / "run", jobs=2000)
    found = recent_jobs(run)
    assert [told["job"] for told in found[:2]] == ["a/segment-001999", "a/segment-001998"]
    assert len(found) == RECENT
    assert log_of(run, "../run.json") is None


@pytest.mark.parametrize("hours", [-30, 0, 30])
def test_whether_a_driver_is_at_work_does_not_hang_on_clocks(tmp_path, hours):
    run = write_run(tmp_path / "run", jobs=1)
    progress = json.loads((run / "progress.json").read_text())
    (run / "progress.json").write_text(json.dumps({**progress, "time": time.time() + 3600 * hours}))
    assert not read_status(run)["running"]
    with locked(run):
        assert read_status(run)["running"]
    assert not read_status(run)["running"]


def test_wrong_places_are_told(tmp_path, capsys):
    run = write_run(tmp_path / "run", jobs=1)
    assert main(["status", str(run), "--html", str(tmp_path / "none/page.html")]) == 2
    assert "page.html cannot be written: " in capsys.readouterr().err
    assert main(["status", str(run), "--serve", "70000"]) == 2
    assert "--serve 70000: expected a port from 0 to 65535" in capsys.readouterr().err
    assert main(["status", str(tmp_path), "--serve", "0"]) == 2
    assert "holds no run" in capsys.readouterr().err
    with make_server(run, 0) as server:
        assert main(["status", str(run), "--serve", str(server.server_port)]) == 2
    assert "name another port" in capsys.readouterr().err
    write_page(run, tmp_path / "page.html")
