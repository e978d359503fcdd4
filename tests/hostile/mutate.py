"""Mutations of real files that hypothesis thinks up, and shrinks to the one that matters once a reader breaks.

Unlike the damages of ``cases``, which are noise, these know what files are made of: numbers in text, fields of two,
four or eight bytes, blocks that are repeated or change places, parts of another format.
"""

from __future__ import annotations

import base64
import collections
import contextlib
import json
import re
import select
import shutil
import struct
import subprocess
import sys
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path

import hypothesis
import hypothesis.strategies as st

from tests.hostile.attack import SECONDS
from tests.hostile.corpus import READERS, Reader

EXAMPLES = 25
"""Mutations of each file."""
ROW = "all files, mutated by hypothesis"
"""In the table."""
HELD = ("read", "refused")

PNG = b"\x89PNG\r\n\x1a\n"
_NUMBER = re.compile(rb"-?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z_]{2,}")
NUMBERS = (
    *(b"0", b"-1", b"1e308", b"-1e999", b"nan", b"inf", b"1e-320", b"0x7fffffff", b"9" * 400, b"9" * 5000),
    b"1" + b"0" * 18,
    *(b"2147483648", b"4294967295", b"60000", b"true", b"[]", b"{}", b'""', b"null", b"[[1]]", b"1,1", b"1 1"),
)  # fmt: skip
FIELDS = tuple(
    struct.pack(order + kind, value)
    for order in "<>"
    for kind, values in (
        ("H", (0, 1, 0x7FFF, 0xFFFF)),
        ("I", (0, 1, 60000, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)),
        ("Q", (0, 1 << 40, (1 << 63) - 1, (1 << 64) - 1)),
        ("f", (float("nan"), float("inf"), -3e38, 1e-45)),
    )
    for value in values
)
TEXTS = (b"[" * 100, b"[" * 5000, b"{" * 5000, b'"', b"\\u0000", b"\n", b"\r", b"\t", b"..", b"/dev/zero", b"../" * 40)

Edit = Callable[[bytes], bytes]


def _spots(data: bytes, pattern: re.Pattern[bytes]) -> list[tuple[int, int]]:
    return [match.span() for match in pattern.finditer(data[:65536])]


@st.composite
def mutated(draw: st.DrawFn, data: bytes, others: tuple[bytes, ...]) -> bytes:
    """A copy of ``data`` with one to four mutations, some of them parts of ``others``."""
    text = data.isascii() and b"\0" not in data
    for _ in range(draw(st.integers(1, 4))):
        size = len(data)
        # Headers decide most.
        at = draw(st.one_of(st.integers(0, min(size, 128)), st.integers(0, size)))
        length = draw(st.sampled_from((1, 2, 4, 8, 32, 200)))
        kind = draw(st.integers(0, 8))
        numbers, words = (_spots(data, _NUMBER), _spots(data, _WORD)) if text else ([], [])
        if kind <= 2 and numbers:
            low, high = numbers[draw(st.integers(0, len(numbers) - 1))]
            data = data[:low] + draw(st.sampled_from(NUMBERS)) + data[high:]
        elif kind == 3 and words:
            low, high = words[draw(st.integers(0, len(words) - 1))]
            other = words[draw(st.integers(0, len(words) - 1))]
            data = data[:low] + data[slice(*other)] + data[high:]
        elif kind <= 2:
            field = draw(st.sampled_from(FIELDS))
            data = data[:at] + field + data[at + len(field) :]
        elif kind == 4:
            data = data[:at] + data[at + length :]
        elif kind == 5:
            data = (
                data[: at + length] + data[at : at + length] * draw(st.sampled_from((1, 3, 500))) + data[at + length :]
            )
        elif kind == 6:
            to = draw(st.integers(0, size))
            block, rest = data[at : at + length], data[:at] + data[at + length :]
            data = rest[:to] + block + rest[to:]
        elif kind == 7:
            piece = draw(st.sampled_from(TEXTS) if text else st.one_of(st.sampled_from(TEXTS), st.binary(max_size=64)))
            data = data[:at] + piece + data[at:]
        else:
            other_data = draw(st.sampled_from(others))
            start = draw(st.integers(0, len(other_data)))
            data = data[:at] + other_data[start : start + 64] + data[at + draw(st.integers(0, 64)) :]
    # A wrong sum is all that a reader of PNG would see.
    return with_right_sums(data) if data[:8] == PNG and draw(st.booleans()) else data


def with_right_sums(data: bytes) -> bytes:
    """A PNG whose chunks have the sums of what they hold, as far as chunks can be told."""
    result, at = bytearray(data), len(PNG)
    while at + 12 <= len(result):
        (length,) = struct.unpack_from(">I", result, at)
        end = at + 8 + length
        if end + 4 > len(result):
            break
        struct.pack_into(">I", result, end, zlib.crc32(result[at + 4 : end]))
        at = end + 4
    return bytes(result)


class Worker:
    """A process that takes in files, and may die of one; another takes its place."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None

    def take(self, reader: int, data: bytes) -> dict[str, str]:
        """What became of one file of ``READERS[reader]``, as ``attack.attempt`` says it."""
        if self._process is None:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "tests.hostile.worker"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        line = json.dumps({"reader": reader, "data": base64.b64encode(data).decode()})
        with contextlib.suppress(BrokenPipeError):  # then there is no answer either
            self._process.stdin.write(line + "\n")
            self._process.stdin.flush()
        waiting, _, _ = select.select([self._process.stdout], [], [], 3 * SECONDS)
        answer = self._process.stdout.readline() if waiting else ""
        if not answer:
            self._process.kill()
            ended = self._process.wait()
            self.close()
            return {"outcome": f"the process ended with {ended}" if waiting else "the process hung"}
        return dict(json.loads(answer))

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            assert self._process.stdin is not None
            assert self._process.stdout is not None
            with contextlib.suppress(BrokenPipeError):
                self._process.stdin.close()
            self._process.stdout.close()
            self._process.wait(60)
            self._process = None


def sound_bytes(reader: Reader) -> bytes:
    """A sound file."""
    folder = Path(tempfile.mkdtemp())
    try:
        reader.make(folder / reader.file)
        return (folder / reader.file).read_bytes()
    finally:
        shutil.rmtree(folder)


def mutate_all(worker: Worker, number: int, check: Callable[[bytes, dict[str, str]], None], examples: int) -> int:
    """Hand ``examples`` mutations of a reader's file to it, the same in every run; returns how many there were.

    Args:
        worker: What takes them in.
        number: Of the reader.
        check: Called with each mutation and what became of it; what raises is shrunk.
        examples: How many.
    """
    sound = sound_bytes(READERS[number])
    others = tuple(sound_bytes(other) for other in READERS if other.name in ("frame, PNG", "scene, TOML", "mesh, GLB"))
    count = 0

    @hypothesis.settings(max_examples=examples, derandomize=True, database=None, deadline=None,
                         suppress_health_check=list(hypothesis.HealthCheck))  # fmt: skip
    @hypothesis.given(mutated(sound, others))
    def run(data: bytes) -> None:
        nonlocal count
        count += 1
        check(data, worker.take(number, data))

    run()
    return count


def main(examples: int) -> int:
    """Mutate every file so many times and print what became of them; 1 where a reader broke."""
    worker, outcomes = Worker(), collections.Counter[str]()
    try:
        for number, reader in enumerate(READERS):

            def note(data: bytes, result: dict[str, str], name: str = reader.name) -> None:
                outcomes[result["outcome"]] += 1
                if result["outcome"] not in HELD:
                    print(name, result, data[:200], sep=" | ", file=sys.stderr)

            mutate_all(worker, number, note, examples)
    finally:
        worker.close()
    print(dict(outcomes))
    return int(not set(outcomes) <= set(HELD))


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1])))
