"""Takes in files one after another, each named by a line of standard input: ``python -m tests.hostile.worker``."""

from __future__ import annotations

import base64
import json
import os
import pathlib
import shutil
import sys
import tempfile

from tests.hostile.attack import attempt, limit_memory
from tests.hostile.cases import Case
from tests.hostile.corpus import READERS


def main() -> None:
    """Answer each line with one, until the input ends."""
    limit_memory()
    results = os.fdopen(os.dup(1), "w", buffering=1)
    # Libraries write to both: what counts is on the copy.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    os.dup2(1, 2)
    with tempfile.TemporaryDirectory() as made:
        sound: dict[int, pathlib.Path] = {}
        for line in sys.stdin:
            request = json.loads(line)
            number = request["reader"]
            reader = READERS[number]
            if number not in sound:
                sound[number] = pathlib.Path(made) / str(number)
                sound[number].mkdir()
                reader.make(sound[number] / reader.file)
            folder = pathlib.Path(made) / "now"
            shutil.copytree(sound[number], folder)
            (folder / reader.file).write_bytes(base64.b64decode(request["data"]))
            case = Case(reader.name, "mutation", lambda where, reader=reader: lambda: reader.read(where / reader.file))
            results.write(json.dumps(attempt(case, folder)) + "\n")
            shutil.rmtree(folder)


if __name__ == "__main__":
    main()
