"""``python -m bench`` lists the benchmarks, ``python -m bench NAME ... [--device D]`` runs them."""

from __future__ import annotations

import argparse
import importlib
import inspect
import sys
from pathlib import Path

from warp_ar.device import resolve_device


def _takes_arguments(name: str) -> bool:
    """Return True if a benchmark has options of its own."""
    return "arguments" in inspect.signature(importlib.import_module(f"bench.bench_{name}").main).parameters


def main() -> int:
    names = sorted(path.stem.removeprefix("bench_") for path in Path(__file__).parent.glob("bench_*.py"))
    parser = argparse.ArgumentParser(prog="python -m bench", description="Benchmarks; one JSON line per case.")
    parser.add_argument("names", nargs="*", metavar="NAME", help="all, or some of: " + ", ".join(names))
    parser.add_argument("--device", default="auto")
    options, rest = parser.parse_known_args()
    if not options.names:
        print("\n".join(names))
        return 0
    chosen = names if options.names == ["all"] else options.names
    if unknown := [name for name in chosen if name not in names]:
        print(f"bench: no benchmark {', '.join(unknown)}; there are {', '.join(names)}", file=sys.stderr)
        return 2
    if rest and (len(chosen) != 1 or not _takes_arguments(chosen[0])):
        parser.error(f"unrecognized arguments: {' '.join(rest)}")
    device = str(resolve_device(options.device))
    for name in chosen:
        importlib.import_module(f"bench.bench_{name}").main(device, *([rest] if rest else []))
    return 0


if __name__ == "__main__":
    sys.exit(main())
