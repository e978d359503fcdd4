"""The command: ``python -m warp_ar.farm run|status|resume|plan``."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path

from warp_ar.begin import importing
from warp_ar.command_line import EXIT_DONE, EXIT_FAILED, Parser, number, run_command
from warp_ar.errors import UsageError, say
from warp_ar.farm.driver import Driver
from warp_ar.farm.jobs import Context, parse_jobs, program_version, read_jobs
from warp_ar.farm.manifest import (
    Manifest,
    RunError,
    begin_run,
    load_run,
    locked,
    read_status,
    status_lines,
)
from warp_ar.farm.pools import Pool, ProcessPool, RayPool, devices_of

WORKERS = number(1, 4096, "a number from 1 to 4096", int)


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command's options."""
    parser = Parser(
        prog="python -m warp_ar.farm",
        description="Light many recordings, or make data sets of them, with several workers. Runs can be resumed.",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="run|status|resume|plan")

    def add(name: str, text: str) -> Parser:
        return commands.add_parser(name, help=text, description=text)

    run = add("run", "begin a run")
    run.add_argument("jobs", type=Path, metavar="JOBS.toml", help="the job file")
    run.add_argument("--output", type=Path, required=True, metavar="DIR", help="the run's new folder")
    resume = add("resume", "continue a run")
    resume.add_argument("folder", type=Path, metavar="DIR", help="the run's folder")
    resume.add_argument("--failed", action="store_true", help="repeat failed jobs")
    for command in (run, resume):
        text = "number of workers (default: one per 4 cores, with GPUs one per 2)"
        command.add_argument("--workers", type=WORKERS, metavar="N", help=text)
        text = "use a Ray cluster's workers (default: a new cluster here)"
        command.add_argument("--ray", nargs="?", const="", metavar="ADDRESS", help=text)
    plan = add("plan", "count the jobs, time three, estimate the time of all")
    plan.add_argument("jobs", type=Path, metavar="JOBS.toml", help="the job file")
    plan.add_argument("--workers", type=WORKERS, metavar="N", help="workers to plan for")
    for command in (run, resume, plan):
        command.add_common("--device")
    status = add("status", "print the progress of a run")
    status.add_argument("folder", type=Path, metavar="DIR", help="the run's folder")
    status.add_argument("--json", action="store_true", help="print JSON")
    return parser


def command(options: argparse.Namespace) -> int:
    """Run a subcommand and return the exit code.

    The job file and the workers are checked before the run's folder is made.

    Raises:
        RunError: The run is damaged, or cannot go on.
        UsageError: ``--workers`` is out of range, the job file cannot be used, or the folder has no run.
    """
    if options.command == "plan":
        return plan(options)
    if options.command == "status":
        status = read_status(options.folder)
        print(json.dumps(status, indent=1) if options.json else "\n".join(status_lines(options.folder, status)))
        return EXIT_DONE
    if options.command == "resume":
        load_run(options.folder)
        return work(options, options.folder, _employer(options))
    data = read_jobs(options.jobs)
    parse_jobs(data, str(options.jobs))
    connect = _employer(options)
    begin_run(options.output, data, program_version())
    return work(options, options.output, connect)


def work(options: argparse.Namespace, folder: Path, employ: Callable[[Context], Pool]) -> int:
    """Do the remaining jobs of a run and return the exit code.

    Args:
        options: Options of the command.
        folder: Folder of the run.
        employ: Function that starts the workers of a run.

    Raises:
        RunError: The run is damaged, or cannot go on.
        UsageError: The folder has no run, or it was begun by another version of the program or with other files.
    """
    data, version = load_run(folder)
    mine = program_version()
    if version != mine:
        raise UsageError(
            f"{folder} was started by {version}; this is {mine}: install that version, or start a new run, as pictures "
            "of two versions may differ"
        )
    jobs = parse_jobs(data, str(folder / "run.json"))
    with locked(folder):
        manifest = Manifest(folder)
        if getattr(options, "failed", False):
            for key in list(manifest.failed):
                manifest.add("again", key, reason="resumed with --failed")
        pool = employ(Context(jobs, folder.absolute(), "cpu"))
        failed = Driver(jobs, folder, manifest, pool).run()
    print("\n".join(status_lines(folder, read_status(folder))))
    return EXIT_FAILED if failed else EXIT_DONE


def _employer(options: argparse.Namespace) -> Callable[[Context], Pool]:
    """Return a function that starts the workers of a run.

    Raises:
        UsageError: The workers cannot be started.
    """
    if options.ray is None:
        devices = devices_of(options.device, options.workers)
        return lambda context: ProcessPool(context, devices)
    return RayPool(options.ray or None, options.workers).employ


def plan(options: argparse.Namespace) -> int:
    """Count jobs, try a few, and print the expected time and size of the run; return the exit code."""
    with importing():
        from warp_ar.farm.plan import tell_plan

    jobs = parse_jobs(read_jobs(options.jobs), str(options.jobs))
    lines, problems = tell_plan(jobs, devices_of(options.device, options.workers))
    for problem in problems:
        say(problem)
    print("\n".join(lines))
    return EXIT_FAILED if problems else EXIT_DONE


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code.

    0 all done, 1 a job failed or the run cannot go on, 2 bad usage or job file, 130 interrupted, 143 terminated.
    """
    return run_command(lambda: command(make_parser().parse_args(arguments)), RunError)
