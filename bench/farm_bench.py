"""What all parts of the farm's benchmark share: options, folder, time that is left, and how results are told."""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import warp as wp

from bench.common import commit

START_SECONDS = 90.0
"""Within which workers should have done their first jobs, kernels compiled."""


@dataclasses.dataclass
class Bench:
    """What all parts share."""

    options: argparse.Namespace
    device: str
    """``cpu`` or ``cuda``."""
    folder: Path
    """For recordings and runs."""
    part: str = ""
    until: float = 0.0
    """When the part should be over, on ``time.monotonic``."""
    begun: float = dataclasses.field(default_factory=time.monotonic)
    costs: dict[str, float] = dataclasses.field(default_factory=dict)
    """Milliseconds of a frame that were measured: ``survey``, ``worker``, ``worker_processor``."""

    @property
    def size(self) -> tuple[int, int]:
        """Of the recordings."""
        return size_of(self.options.size)

    @property
    def one_device(self) -> str:
        """Of a worker alone: ``cpu`` or the first GPU."""
        return "cpu" if self.device == "cpu" else "cuda:0"

    @property
    def left(self) -> float:
        """Seconds that the part has."""
        return self.until - time.monotonic()

    def say(self, line: str) -> None:
        """A line of progress."""
        print(f"[{time.monotonic() - self.begun:6.1f} s] {self.part}: {line}", file=sys.stderr, flush=True)

    def tell(self, case: str, **figures: Any) -> None:
        """One result."""
        names = [str(device.name) for device in wp.get_cuda_devices()] if self.device != "cpu" else []
        record = {
            "case": f"farm {case}",
            "size": self.options.variation_size if self.part == "variations" else self.options.size,
            **figures,
            "quality": self.options.quality,
            "decode": self.options.decode,
            "gpus": names,
            "cores": len(os.sched_getaffinity(0)),
            "warp": wp.__version__,
            "commit": commit(),
        }
        line = json.dumps(record)
        print(line, flush=True)
        if self.options.output is not None:
            self.options.output.mkdir(parents=True, exist_ok=True)
            with open(self.options.output / f"farm_{self.part}.jsonl", "a", encoding="utf-8") as stream:
                stream.write(line + "\n")


def size_of(text: str) -> tuple[int, int]:
    """Width and height of ``WxH``."""
    width, _, height = text.partition("x")
    return int(width), int(height)


def numbers_of(text: str) -> list[int]:
    """Numbers with commas between."""
    return [int(part) for part in text.split(",")]
