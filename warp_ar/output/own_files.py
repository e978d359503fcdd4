"""Files of known names that a command writes into a folder: each whole, none over a file of somebody else's."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from warp_ar.errors import SinkError, printable, reason
from warp_ar.files import write_whole
from warp_ar.output.places import check_places, check_replaceable


class OwnFiles:
    """A folder, and the files that a command may write there."""

    def __init__(
        self,
        folder: Path,
        names: Iterable[str],
        *,
        overwrite: bool,
        role: str = "--out",
        reads: Mapping[str, Sequence[Path]] | None = None,
    ) -> None:
        """Refuse before anything is computed; say on stderr what will be replaced.

        Args:
            folder: Made if it is not there.
            names: Of all files that may be written.
            overwrite: Whether files that this program did not write may be replaced.
            role: Of the folder, in messages.
            reads: What the command reads, by what it is ("--extra").

        Raises:
            SinkError: A file may not be replaced, or the folder cannot be made.
            UsageError: A file is one that is read.
        """
        self._folder, self._names, self._role = folder, tuple(names), role
        replaced = []
        for name in self._names:
            check_places(reads or {}, {role: folder / name})
            replaced.append(check_replaceable(folder / name, overwrite=overwrite))
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise SinkError(f"{role} {folder} cannot be made: {reason(error)}") from error
        for words in filter(None, replaced):
            print(f"warp_ar: {printable(words)}", file=sys.stderr)

    def write(self, name: str, data: str | bytes) -> Path:
        """Write a file, text as UTF-8; returns its path.

        Raises:
            SinkError: It cannot be written; what stood there stays.
            ValueError: It is none of ``names``.
        """
        if name not in self._names:
            raise ValueError(f"{name} is not among the files that were looked at: {', '.join(self._names)}")
        path = self._folder / name
        try:
            write_whole(path, data.encode() if isinstance(data, str) else data)
        except OSError as error:
            raise SinkError(f"{self._role} {path} cannot be written: {reason(error)}") from error
        return path
