"""Where output may go: never onto what is read, and onto a file of somebody else's only where that is allowed.

What this program wrote, by its signature, is replaced, and the sink says that it was; any other file is left alone
unless overwriting is asked for.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import filelock

from warp_ar.errors import SinkError, UsageError, reason
from warp_ar.files import is_same_file, kind_of
from warp_ar.signature import is_signed

_NUMBERED = re.compile(r"[0-9]{4,}\.(png|exr)")


def check_replaceable(path: Path, *, overwrite: bool) -> str:
    """Find out whether a file may be written.

    Args:
        path: The file.
        overwrite: Whether a file that this program did not write may be replaced.

    Returns:
        What is lost, in words; empty where that is nothing.

    Raises:
        SinkError: It may not be, or is no regular file.
    """
    try:
        kind = kind_of(path)
        if kind == "nothing":
            return ""
        if kind != "file":
            raise SinkError(f"{path} is {'a folder' if kind == 'folder' else kind}; name a file")
        if os.stat(path).st_size == 0:
            return ""
    except OSError as error:
        raise SinkError(f"{path} cannot be written: {reason(error)}") from error
    if is_signed(path):
        return f"{path} is replaced: this program wrote it before"
    if overwrite:
        return f"{path} is replaced, as --overwrite says"
    raise SinkError(f"{path} is there, and this program did not write it; name another, or replace it with --overwrite")


def earlier_frames(folder: Path, suffix: str, *, overwrite: bool) -> list[Path]:
    """Numbered frames that an earlier run left in a folder, and that a new one must not stand beside.

    Raises:
        SinkError: This program did not write one of them, and ``overwrite`` is not asked for.
    """
    try:
        names = sorted(entry.name for entry in os.scandir(folder) if entry.is_file())
    except OSError as error:
        raise SinkError(f"{folder} cannot be read: {reason(error)}") from error
    numbered = (_NUMBERED.fullmatch(name) for name in names)
    frames = [folder / match.string for match in numbered if match is not None and match[1] == suffix.removeprefix(".")]
    foreign = [] if overwrite else [path for path in frames if not is_signed(path)]
    if foreign:
        raise SinkError(
            f"{folder} holds {len(foreign)} numbered frames that this program did not write, such as "
            f"{foreign[0].name}; name another folder, or replace them with --overwrite"
        )
    return frames


def check_places(reads: Mapping[str, Sequence[Path]], writes: Mapping[str, Path]) -> None:
    """See to it that nothing is written over what is read, or twice.

    Args:
        reads: Files and folders that are read, by what they are ("--source").
        writes: Files and folders that are to be written, by what asks for them ("--output").

    Raises:
        UsageError: Two are one, by whatever links, or a numbered frame would be one of the others.
    """
    entries = [(role, path) for role, paths in reads.items() for path in paths]
    for written, place in writes.items():
        for role, path in entries:
            if is_same_file(place, path):
                raise UsageError(f"{written} {place} is the same as {role} {path}; name another place")
            inside = _NUMBERED.fullmatch(path.name) is not None and is_same_file(place, path.parent)
            outside = _NUMBERED.fullmatch(place.name) is not None and is_same_file(path, place.parent)
            if inside or outside:
                raise UsageError(f"{written} {place} would number frames beside {role} {path}; name another")
        entries.append((written, place))


@contextlib.contextmanager
def folder_to_oneself(folder: Path) -> Iterator[None]:
    """Keep other runs from writing frames into a folder; the lock's file is removed at the end.

    Raises:
        UsageError: Another run has it.
    """
    lock = filelock.FileLock(folder / ".warp_ar.lock", timeout=0, mode=0o666)
    try:
        lock.acquire()
    except filelock.Timeout as error:
        raise UsageError(f"{folder} is in use: another run writes frames into it; give another --output") from error
    except (OSError, NotImplementedError):
        yield  # a disk that cannot lock still takes frames
        return
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            os.unlink(lock.lock_file)
        lock.release()
