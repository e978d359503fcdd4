"""``python -m warp_ar.keys [SECTION]``: prints the keys of scene files with meaning, unit, default and example."""

from __future__ import annotations

if __name__ == "__main__":
    from warp_ar.begin import begin

    begin("warp_ar.keys")

import argparse
from collections.abc import Sequence

from warp_ar.command_line import EXIT_DONE, Parser, run_command
from warp_ar.errors import UsageError, printable
from warp_ar.scene.key_tables import keys
from warp_ar.scene.messages import nearest


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command's options."""
    parser = Parser(prog="python -m warp_ar.keys", description="Print the keys of scene files, with unit and example.")
    parser.add_argument("section", nargs="?", metavar="SECTION", help="one section, such as camera or object.material")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return run_command(lambda: print_keys(make_parser().parse_args(arguments).section))


def print_keys(section: str | None) -> int:
    """Print all keys, or those of one section.

    Raises:
        UsageError: There is no such section.
    """
    sections = list(dict.fromkeys(key.section for key in keys()))
    wanted = None if section is None else section.strip("[]")
    if wanted is not None and wanted not in sections:
        raise UsageError(f"no section {printable(wanted)} in scene files; {nearest(wanted, sections)}")
    for name in sections if wanted is None else [wanted]:
        print(f"[{name}]" if name else "at the top of the file")
        for key in keys():
            if key.section == name:
                unit = "" if key.unit == "-" else f", {key.unit}"
                print(f"  {key.name} = {key.example}    ({key.default}{unit})\n      {key.meaning}")
    return EXIT_DONE
