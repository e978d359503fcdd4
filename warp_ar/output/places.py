"""Rules for places of output: never onto what is read, and onto a file of somebody else's only if that is allowed.

What this program wrote, by its signature, is replaced, and the sink says that it was; any other file is left alone
unless overwriting is asked for.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import filelock

from warp_ar.errors import SinkError, UsageError, reason, say
from warp_ar.files import is_same_file, kind_of, store
from warp_ar.output.sink import make_folder
from warp_ar.scene import Scene
from warp_ar.scene.scene_files import files_of
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


def claim_places(reads: Mapping[str, Sequence[Path]], writes: Mapping[str, Path], *, overwrite: bool) -> None:
    """Check places as `check_places`, say which files are replaced, and make the folders of all.

    Args:
        reads: As for `check_places`.
        writes: Files that are to be written, by what asks for them.
        overwrite: Whether files that this program did not write may be replaced.

    Raises:
        UsageError: Two are one.
        SinkError: A file may not be replaced, or a folder cannot be made.
    """
    check_places(reads, writes)
    for words in [check_replaceable(path, overwrite=overwrite) for path in writes.values()]:
        if words:
            say(words)
    for path in writes.values():
        make_folder(path.parent)


def reads_of(scene: Scene, options: argparse.Namespace) -> dict[str, list[Path]]:
    """Return files and folders that a command reads, by what they are, as ``check_places`` takes them."""
    named = {f"--{name}": getattr(options, name, None) for name in ("source", "calibration", "light")}
    reads = {name: [Path(value)] for name, value in named.items() if value is not None and "://" not in str(value)}
    reads["the scene"] = [] if scene.path is None else [scene.path]
    reads["what the scene names,"] = [path for path in files_of(scene) if path != scene.path]
    return reads


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
            say(words)

    def write(self, name: str, data: str | bytes) -> Path:
        """Write a file, text as UTF-8; returns its path.

        Raises:
            SinkError: It cannot be written; what stood there stays.
            ValueError: It is none of ``names``.
        """
        if name not in self._names:
            raise ValueError(f"{name} is not among the files that were looked at: {', '.join(self._names)}")
        path = self._folder / name
        store(path, data.encode() if isinstance(data, str) else data, label=f"{self._role} {path}")
        return path
