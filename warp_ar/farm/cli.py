"""The command: ``python -m warp_ar.farm run|status|resume|plan``."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path

from warp_ar.begin import importing
from warp_ar.command_line import EXIT_DONE, EXIT_FAILED, Parser, run_command
from warp_ar.errors import UsageError, printable, say
from warp_ar.farm.driver import Driver
from warp_ar.farm.jobs import Context, parse_jobs, program_version, read_jobs
from warp_ar.farm.manifest import (
    Manifest,
    RunError,
    begin_run,
    clear_aside,
    load_run,
    locked,
    read_status,
    status_lines,
    words_of_seconds,
)
from warp_ar.farm.pools import Pool, ProcessPool, RayPool, cores_of, devices_of, keeping_to

MOST_WORKERS = 4096


def make_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = Parser(
        prog="python -m warp_ar.farm",
        description="Light many recordings, or make a data set of them, with several workers; resume after any death.",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="run|status|resume|plan")
    run = commands.add_parser("run", help="begin a run")
    run.add_argument("jobs", type=Path, metavar="JOBS.toml", help="clips, and what is to be made of them")
    run.add_argument("--output", type=Path, required=True, metavar="DIR", help="a new folder for everything")
    resume = commands.add_parser("resume", help="go on with a run")
    resume.add_argument("folder", type=Path, metavar="DIR", help="the run's folder")
    resume.add_argument("--failed", action="store_true", help="try jobs again that have failed for good")
    for command in (run, resume):
        command.add_argument(
            "--workers",
            type=int,
            metavar="N",
            help="workers here (default: one per 4 cores, on GPUs one per 2)",
        )
        command.add_argument(
            "--ray",
            nargs="?",
            const="",
            metavar="ADDRESS",
            help="workers of a Ray cluster, or of one that is started here",
        )
    plan = commands.add_parser("plan", help="count jobs, try three of them on a few frames, say what all would take")
    plan.add_argument("jobs", type=Path, metavar="JOBS.toml", help="clips, and what is to be made of them")
    plan.add_argument("--workers", type=int, metavar="N", help="workers that there will be")
    for command in (run, resume, plan):
        command.add_argument("--device", default="auto", metavar="auto|cpu|cuda", help="where the kernels run")
    status = commands.add_parser("status", help="say where a run stands")
    status.add_argument("folder", type=Path, metavar="DIR", help="the run's folder")
    status.add_argument("--json", action="store_true", help="as JSON")
    return parser


def command(options: argparse.Namespace) -> int:
    """Do what the options ask for.

    Raises:
        UsageError: ``--workers`` is out of bounds, or as the command of the farm raises it.
    """
    workers = getattr(options, "workers", None)
    if workers is not None and not 1 <= workers <= MOST_WORKERS:
        raise UsageError(f"--workers {workers}: expected a number from 1 to {MOST_WORKERS}")
    match options.command:
        case "run":
            return begin(options)
        case "resume":
            return resume(options)
        case "plan":
            return plan(options)
    return tell_status(options)


def tell_status(options: argparse.Namespace) -> int:
    """Print where a run stands.

    Raises:
        RunError: The run is damaged.
        UsageError: There is none in the folder.
    """
    status = read_status(options.folder)
    print(json.dumps(status, indent=1) if options.json else "\n".join(status_lines(options.folder, status)))
    return EXIT_DONE


def begin(options: argparse.Namespace) -> int:
    """Begin a run, and work through it; what cannot be begun leaves no folder."""
    data = read_jobs(options.jobs)
    parse_jobs(data, str(options.jobs))
    connect = _employer(options)
    begin_run(options.output, data, program_version())
    return work(options, options.output, connect)


def resume(options: argparse.Namespace) -> int:
    """Go on with a run."""
    load_run(options.folder)
    return work(options, options.folder, _employer(options))


def work(options: argparse.Namespace, folder: Path, employ: Callable[[Context], Pool]) -> int:
    """Work through what is open of a run.

    Raises:
        RunError: The run is damaged, or cannot go on.
        UsageError: There is none in the folder, or another version of the program or other files began it.
    """
    data, version = load_run(folder)
    mine = program_version()
    if version != mine:
        raise UsageError(
            f"{folder} was begun by {version}; this is {mine}: install that version, or begin a new run, for "
            "pictures of two programs are not of one kind"
        )
    jobs = parse_jobs(data, str(folder / "run.json"))
    with locked(folder):
        clear_aside(folder)
        manifest = Manifest(folder, write=True)
        try:
            if getattr(options, "failed", False):
                for key in list(manifest.failed):
                    manifest.add("again", key, reason="resumed with --failed")
            pool = employ(Context(jobs, folder.absolute(), "cpu"))
            failed = Driver(jobs, folder, manifest, pool, mine, say).run()
        finally:
            manifest.close()
            clear_aside(folder)  # what workers that were killed left takes room, and is nobody's
    return _tell(folder, failed)


def _employer(options: argparse.Namespace) -> Callable[[Context], Pool]:
    """Return what makes the workers of a run; here it is found out whether there can be any."""
    if options.ray is None:
        devices = devices_of(options.device, options.workers)
        return lambda context: ProcessPool(context, devices)
    pool = RayPool(options.ray or None, options.workers)
    if page := pool.dashboard():
        say(f"Ray's page: http://{page}")
    return pool.employ


def _tell(folder: Path, failed: dict[str, str]) -> int:
    """Say how a run went; returns the exit code."""
    status = read_status(folder)
    counts = ", ".join(f"{count} {kind}{'s' if count != 1 else ''}" for kind, count in sorted(status["done"].items()))
    print(printable(f"{folder}: {counts or 'nothing'} done, {status['frames']} frames, {status['bytes'] / 1e6:.1f} MB"))
    if not failed:
        return EXIT_DONE
    print(f"{len(failed)} job{'s' if len(failed) != 1 else ''} failed:")
    for key, why in sorted(failed.items())[:50]:
        print(printable(f"  {key}: {why}"))
    return EXIT_FAILED


def plan(options: argparse.Namespace) -> int:
    """Count jobs, try a few, and say what all would take."""
    with importing():
        from warp_ar.farm.plan import make_plan

    jobs = parse_jobs(read_jobs(options.jobs), str(options.jobs))
    devices = devices_of(options.device, options.workers)
    cores = cores_of(devices)
    with keeping_to(cores[0]):  # as a worker has them
        found = make_plan(jobs, devices[0], say)
    # Workers that share a core are no faster than one that has it.
    at_once = len({core for own in cores for core in own} or devices) if devices[0] == "cpu" else len(devices)
    for problem in found.problems:
        say(problem)
    kind = "segments" if jobs.dataset is None else "variations"
    print(f"{found.clips} clips, {found.jobs} {kind}, {found.frames} frames to light, {found.surveyed} to survey")
    print(
        f"a frame: {found.frame_ms:.1f} ms lit and written, {found.survey_ms:.1f} ms surveyed, at quality "
        f"{jobs.settings.quality} on {devices[0]}"
    )
    for count in sorted({1, len(devices)}):
        print(f"{count} worker{'s' if count > 1 else ''}: {words_of_seconds(found.seconds(min(count, at_once)))}")
    kept = f", beside {found.survey_bytes / 1e6:.1f} MB that surveys keep" if found.survey_bytes else ""
    print(f"output: {found.bytes / 1e6:.1f} MB{kept}")
    return EXIT_FAILED if found.problems else EXIT_DONE


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code.

    0 all done, 1 a job failed or the run cannot go on, 2 bad usage or job file, 130 interrupted, 143 terminated.
    """
    return run_command(lambda: command(make_parser().parse_args(arguments)), RunError)
