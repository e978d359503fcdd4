"""Files: kinds and sizes that may be read, and writing that leaves a complete file or none.

Only regular files are read: a named pipe or a device could block the reader or never end. Sizes are checked against
`Limits` before anything is decoded; an environment variable sets each limit. A written file appears under its name only
when it is complete.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import pathlib
import re
import secrets
import stat
import tomllib
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from warp_ar.errors import SinkError, UsageError, WarpArError, reason

_CHUNK = 1 << 20

_BRACKETS = np.zeros(256, np.int8)
_BRACKETS[[ord("["), ord("{")]] = 1
_BRACKETS[[ord("]"), ord("}")]] = -1

_MOST_DOTS: Final = 16
_PART: Final = r"""(?:[A-Za-z0-9_-]+|"[^"\n]*"|'[^'\n]*')"""
_DECIMAL_COMMA = re.compile(r"^[ \t]*[\w.-]+[ \t]*=[ \t]*(-?\d+),(\d+)[ \t]*(?:#.*)?$", re.MULTILINE)
_MANY_DOTS: Final = re.compile(rf"(?m)(?:^|[\[{{,])[ \t]*{_PART}(?:[ \t]*\.[ \t]*{_PART}){{{_MOST_DOTS}}}")


@dataclasses.dataclass(frozen=True)
class Limits:
    """Largest sizes of files. The environment variable of a field is ``WARP_AR_MAX_`` and its name in capitals."""

    picture_pixels: int = 1 << 26
    """Pixels of a frame, a texture, a video's frame or an environment, as the file's header states them."""
    picture_bytes: int = 1 << 29
    """Bytes of a picture's or an environment's file."""
    text_bytes: int = 1 << 22
    """Bytes of a scene, a calibration, a response, a list of exposures or an OBJ's material library."""
    mesh_bytes: int = 1 << 28
    """Bytes of a mesh file, and of each buffer file that it names."""
    mesh_elements: int = 20_000_000
    """Vertices, or faces, of a mesh, as the file's header states them where it does."""
    scene_entries: int = 2000
    """Tables of one section of a scene: objects, proxies, lights or mirror balls."""
    run_bytes: int = 1 << 30
    """Bytes of each file that a run of the farm keeps about its progress."""
    nesting: int = 64
    """Levels of brackets, tags or indentation in a file."""


def variable_of(name: str) -> str:
    """Return the environment variable that sets a field of `Limits`."""
    return f"WARP_AR_MAX_{name.upper()}"


def limits() -> Limits:
    """Return the limits in effect.

    Raises:
        UsageError: An environment variable is not an integer above 0.
    """
    given = {}
    for field in dataclasses.fields(Limits):
        variable = variable_of(field.name)
        text = os.environ.get(variable)
        if text is None:
            continue
        if not (text.isascii() and text.isdecimal() and int(text[:18]) > 0 and len(text) <= 18):
            raise UsageError(f"{variable}={text[:40]!r}: expected a whole number above 0, up to 18 digits")
        given[field.name] = int(text)
    return Limits(**given)


def too_much(label: str, amount: int, what: str, name: str) -> str:
    """Return the message for a file that exceeds the limit ``name``."""
    most = getattr(limits(), name)
    return f"{label} has {amount:,} {what}; at most {most:,} are read (set {variable_of(name)} for more)"


def check_size(width: int, height: int, error: type[WarpArError], label: str) -> None:
    """Check the size in pixels that a picture's header states.

    Raises:
        WarpArError: As ``error``: the picture is empty or too large.
    """
    if width < 1 or height < 1:
        raise error(f"{label} cannot be read: its header promises {width}x{height} pixels")
    if width * height > limits().picture_pixels:
        raise error(too_much(f"{label} is {width}x{height}: it", width * height, "pixels", "picture_pixels"))


def kind_of(path: str | os.PathLike[str]) -> str:
    """Return the kind of file that a path leads to.

    Returns:
        "file", "folder", "nothing", or a description of another kind: "a named pipe", "a device", "a socket".

    Raises:
        OSError: The path cannot be examined, for example because it is too long.
    """
    try:
        mode = os.stat(path).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return "nothing"
    except ValueError as error:  # a zero byte, an unpaired surrogate
        raise OSError(f"the name cannot be one: {reason(error)}") from error
    if stat.S_ISREG(mode):
        return "file"
    if stat.S_ISDIR(mode):
        return "folder"
    return "a named pipe" if stat.S_ISFIFO(mode) else "a socket" if stat.S_ISSOCK(mode) else "a device"


def is_file(path: str | os.PathLike[str], kind: str = "file") -> bool:
    """Return True if a path leads to a regular file; False also for an invalid path."""
    try:
        return kind_of(path) == kind
    except OSError:
        return False


def is_folder(path: str | os.PathLike[str]) -> bool:
    """Return True if a path leads to a folder; False also for an invalid path."""
    return is_file(path, "folder")


def read_bytes(path: str | os.PathLike[str], limit: str, error: type[WarpArError], label: str | None = None) -> bytes:
    """Return the content of a regular file.

    Args:
        path: The file.
        limit: Field of `Limits` with the largest size in bytes.
        error: Class of the error to raise.
        label: Name of the file in messages; None: its path.

    Raises:
        WarpArError: As ``error``: the file does not exist, is not regular, is too large, or cannot be read.
    """
    label = str(path) if label is None else label
    most = getattr(limits(), limit)
    try:
        kind = kind_of(path)
        if kind == "nothing":
            raise error(f"{label} is not there")
        if kind != "file":
            raise error(f"{label} is {'a folder' if kind == 'folder' else kind}; a regular file is needed")
        # Non-blocking: the file may be replaced by a pipe before it is opened.
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
        with os.fdopen(os.open(path, flags), "rb", buffering=0) as stream:
            size = os.fstat(stream.fileno()).st_size
            if size > most:
                raise error(too_much(label, size, "bytes", limit))
            parts, length = [], 0
            while part := stream.read(max(_CHUNK, size + 1 - length)):
                parts.append(part)
                length += len(part)
                if length > most:
                    raise error(too_much(label, length, "bytes or more", limit))
    except OSError as problem:
        raise error(f"{label} cannot be read: {reason(problem)}") from problem
    return parts[0] if len(parts) == 1 else b"".join(parts)


def read_text(path: str | os.PathLike[str], error: type[WarpArError], *, expected: str) -> str:
    """Return the text of a regular UTF-8 file; arguments as for `read_bytes`, ``expected`` names the format.

    Raises:
        WarpArError: As ``error``: the file cannot be read, is too large, or is not UTF-8.
    """
    data = read_bytes(path, "text_bytes", error)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as problem:
        raise error(f"{path}: not a text file in UTF-8 (byte {problem.start}); expected {expected}") from problem


def bracket_depth(text: str) -> int:
    """Return an upper bound of the nesting of square and curly brackets; brackets within quotes count too."""
    steps = _BRACKETS[np.frombuffer(text.encode("utf-8", "replace"), np.uint8)]
    return int(np.cumsum(steps[steps != 0], dtype=np.int64).max(initial=0))


def indentation_depth(text: str) -> int:
    """Return the deepest indentation of a YAML text in levels: each deeper column and each dash on a line is one."""
    columns: list[int] = []
    deepest = 0
    for line in text.splitlines():
        match = re.match(r" *(?:[-?] +)*", line)
        if match is None or match.end() == len(line):
            continue
        lead = match[0]
        starts = [len(lead) - len(lead.lstrip(" "))]
        starts += [place.end() for place in re.finditer(r"[-?] +", lead)]
        while columns and columns[-1] >= starts[0]:
            columns.pop()
        columns += starts
        deepest = max(deepest, len(columns))
    return deepest


def tag_depth(text: str) -> int:
    """Return the largest number of XML tags that are open at once."""
    depth = deepest = 0
    for match in re.finditer(r"<(/?)[A-Za-z_][^<>]*?(/?)>", text):
        depth += 0 if match[2] else -1 if match[1] else 1
        deepest = max(deepest, depth)
    return deepest


def parse_json(text: str, label: str, error: type[WarpArError]) -> Any:
    """Return the parsed JSON of an untrusted text.

    Raises:
        WarpArError: As ``error``: the text is damaged or nested too deeply.
    """
    check_depth(bracket_depth(text), label, error)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as problem:
        raise error(f"{label} cannot be read: {reason(problem)}") from problem


def parse_toml(text: str, label: str, error: type[WarpArError]) -> dict[str, Any]:
    """Return the parsed TOML of an untrusted text.

    Raises:
        WarpArError: As ``error``: the text is damaged or nested too deeply, or a dotted key has too many parts. Each
            part is a nested table, and the parser's time grows with their number.
    """
    check_depth(bracket_depth(text), label, error)
    if match := _MANY_DOTS.search(text):
        line = text.count("\n", 0, match.start()) + 1
        raise error(f"{label}: line {line}: a key of more than {_MOST_DOTS} parts; the longest here has 3")
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as problem:  # ValueError: TOMLDecodeError, and integers of too many digits
        comma = _DECIMAL_COMMA.search(text)
        hint = f"; {comma[1]},{comma[2]} is written {comma[1]}.{comma[2]}" if comma else ""
        raise error(f"{label}: not valid TOML: {reason(problem)}{hint}") from problem


def check_depth(depth: int, label: str, error: type[WarpArError]) -> None:
    """Check the nesting depth of a text against the limit.

    Raises:
        WarpArError: As ``error``: the text is nested too deeply.
    """
    if depth > limits().nesting:
        raise error(too_much(f"{label}: it", depth, "levels of nesting", "nesting"))


def write_whole(
    path: str | os.PathLike[str],
    write: bytes | Callable[[pathlib.Path], object],
    *,
    suffix: str = "",
    keep_links: bool = False,
) -> None:
    """Write a file under a temporary name and rename it when it is complete; an existing file stays until then.

    Args:
        path: The file. A symbolic link is followed; the mode of an existing file is kept.
        write: The content, or a function that writes it to the temporary path that it receives.
        suffix: Ending of the temporary path, for libraries that choose the format by it.
        keep_links: Whether other hard links of the file get the new content too, for a user's file that is amended.

    Raises:
        OSError: The file cannot be written; the existing one is unchanged.
    """
    path = pathlib.Path(os.path.realpath(path))
    kind = kind_of(path)
    if kind not in ("file", "nothing"):
        raise OSError(f"it is {'a folder' if kind == 'folder' else kind}, not a file")
    part = name_aside(path, suffix)
    # The name is chosen before the file exists, so that a signal in between leaves no file.
    try:
        with os.fdopen(create_new(part), "wb") as stream:
            if not callable(write):
                stream.write(write)
        if callable(write):
            write(part)
        before = os.stat(path) if kind == "file" else None
        if before is not None and keep_links and before.st_nlink > 1:
            path.write_bytes(part.read_bytes())  # writing the temporary file has shown that the disk has room
            part.unlink()
            return
        if before is not None:
            part.chmod(stat.S_IMODE(before.st_mode) & 0o777)
        take_name(part, path)
    except BaseException:
        with contextlib.suppress(OSError):
            part.unlink()
        raise


def store(path: pathlib.Path, write: bytes | Callable[[pathlib.Path], object], *, suffix: str = "") -> None:
    """Write a file with `write_whole`; name the file in the error.

    Raises:
        SinkError: The file cannot be written; an existing one is unchanged.
    """
    try:
        write_whole(path, write, suffix=suffix)
    except (OSError, RuntimeError) as error:  # RuntimeError: raised by OpenEXR
        raise SinkError(f"{path} cannot be written: {reason(error)}") from error


def name_aside(path: pathlib.Path, suffix: str = "") -> pathlib.Path:
    """Return a hidden, random path next to ``path``, for a file that is renamed to ``path`` when it is complete.

    Args:
        path: Final path (see `take_name`).
        suffix: Ending of the temporary name.
    """
    name = path.name if len(os.fsencode(path.name)) <= 200 else f"{path.stem[:40]}{path.suffix[:8]}"
    return path.with_name(f".{name}.{secrets.token_hex(8)}.part{suffix}")


def create_new(path: pathlib.Path) -> int:
    """Create an empty file where none exists; a link of that name is not followed.

    Returns:
        File descriptor, open for reading and writing.

    Raises:
        OSError: The file cannot be created, or the name is taken.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL
    for extra in ("O_NOFOLLOW", "O_CLOEXEC", "O_BINARY"):
        flags |= getattr(os, extra, 0)
    return os.open(path, flags, 0o666)


def take_name(part: pathlib.Path, path: pathlib.Path) -> None:
    """Rename a complete temporary file to its final path, replacing an existing file.

    Raises:
        OSError: The file cannot be renamed.
    """
    part.replace(path)


def is_same_file(a: pathlib.Path, b: pathlib.Path) -> bool:
    """Return True if two paths lead to the same file or folder, links resolved; neither needs to exist."""
    try:
        return os.path.realpath(a) == os.path.realpath(b) or (os.path.exists(a) and os.path.samefile(a, b))
    except (OSError, ValueError):
        return False
