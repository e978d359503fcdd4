"""Rules for output files: inputs are never overwritten, and other programs' files only on request.

A file written by this program, recognised by its signature, is replaced with a note. Any other file is kept unless
overwriting is requested.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import filelock

from warp_ar.errors import SinkError, UsageError, reason, say
from warp_ar.files import is_same_file, kind_of
from warp_ar.output.sink import make_folder
from warp_ar.scene import Scene
from warp_ar.scene.scene_files import files_of
from warp_ar.signature import is_signed

_NUMBERED = re.compile(r"[0-9]{4,}\.(png|exr)")


def check_replaceable(path: Path, *, overwrite: bool) -> str:
    """Check that a file may be written.

    Args:
        path: The file.
        overwrite: True to replace a file that this program did not write.

    Returns:
        Description of the file that is replaced; empty if there is none.

    Raises:
        SinkError: The file must not be replaced, or is no regular file.
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
    """Return the numbered frames of an earlier run in a folder, which must be removed before a new run.

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
    """Check that no output overwrites an input or another output.

    Args:
        reads: Files and folders that are read, by option or role ("--source").
        writes: Files and folders that are written, by option ("--output").

    Raises:
        UsageError: Two paths are the same file, also by links, or a numbered frame would be one of the others.
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
    """Check outputs as `check_places`, report the files that are replaced, and make all folders.

    Args:
        reads: As for `check_places`.
        writes: Files that are written, by option.
        overwrite: True to replace files that this program did not write.

    Raises:
        UsageError: Two paths are the same file.
        SinkError: A file may not be replaced, or a folder cannot be made.
    """
    check_places(reads, writes)
    for words in [check_replaceable(path, overwrite=overwrite) for path in writes.values()]:
        if words:
            say(words)
    for folder in dict.fromkeys(path.parent for path in writes.values()):
        make_folder(folder)


def reads_of(scene: Scene, options: argparse.Namespace) -> dict[str, list[Path]]:
    """Return the files and folders that a command reads, by role, for ``check_places``."""
    named = {f"--{name}": getattr(options, name, None) for name in ("source", "calibration", "light")}
    reads = {name: [Path(value)] for name, value in named.items() if value is not None and "://" not in str(value)}
    reads["the scene"] = [] if scene.path is None else [scene.path]
    reads["what the scene names,"] = [path for path in files_of(scene) if path != scene.path]
    return reads


@contextlib.contextmanager
def folder_to_oneself(folder: Path) -> Iterator[None]:
    """Lock a folder against other runs while frames are written; the lock file is removed at the end.

    Raises:
        UsageError: Another run has locked the folder.
    """
    lock = filelock.FileLock(folder / ".warp_ar.lock", timeout=0, mode=0o666)
    try:
        lock.acquire()
    except filelock.Timeout as error:
        raise UsageError(f"{folder} is in use: another run writes frames into it; give another --output") from error
    except (OSError, NotImplementedError):
        yield  # a file system without locks is accepted
        return
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            os.unlink(lock.lock_file)
        lock.release()
