"""``python -m warp_ar`` lists all commands; ``python -m warp_ar COMMAND ...`` runs one."""

from __future__ import annotations

if __name__ == "__main__":
    from warp_ar.begin import begin

    begin("warp_ar.__main__")

import importlib
import sys
from collections.abc import Sequence

from warp_ar.begin import importing
from warp_ar.command_line import EXIT_DONE, run_command
from warp_ar.errors import UsageError, printable
from warp_ar.scene.messages import nearest

COMMANDS = {
    "init": "make a folder to start your own desk from, with the card to print",
    "live": "light a scene: the page, or --output FILE; without a scene the bundled desk",
    "calibrate": "measure camera, ball and response; print a card or marker",
    "doctor": "find faults of a set-up, with remedies",
    "capture": "make an environment from photographs of a mirror ball",
    "pose": "find a photograph's camera from known points; write a scene with it and captured light",
    "environment": "write an environment for other programs",
    "export": "write a scene and its camera's path for other programs",
    "explain": "list the stages that a scene needs, and why others are left out",
    "keys": "list the keys of scene files, with unit, default and example",
    "farm": "light many recordings, make data sets",
    "tradeoff": "measure accuracy against cost on this machine",
    "paper": "reproduce the paper's figures",
    "reference": "path-trace one frame, as the reference for other methods",
}
"""Names of the commands, each with its purpose."""


def _run(arguments: Sequence[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        print("usage: python -m warp_ar COMMAND ...; COMMAND --help lists a command's options")
        for name, text in COMMANDS.items():
            print(f"  {name:12s} {text}")
        print("to start: python -m warp_ar.live, or for your own desk python -m warp_ar.init my_desk")
        return EXIT_DONE
    name, *rest = arguments
    if name not in COMMANDS:
        raise UsageError(f"no command {printable(name)}; {nearest(name, COMMANDS)}")
    with importing():
        module = importlib.import_module("warp_ar.farm.cli" if name == "farm" else f"warp_ar.{name}")
    return int(module.main(rest))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return run_command(lambda: _run(sys.argv[1:] if arguments is None else arguments))
