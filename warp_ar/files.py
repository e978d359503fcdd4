"""Files of anyone's making: what may be read, how much of it, and how a file is written so that it is always whole.

Only regular files are read: a named pipe or a device would keep a reader waiting, or never end. Sizes are limited
before anything is decoded, by the numbers of `Limits`, each of which an environment variable sets. What is written
appears under its name only when it is whole.
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
    """Largest sizes of files; each field has the environment variable ``WARP_AR_MAX_`` and its name in capitals."""

    picture_pixels: int = 1 << 26
    """Pixels of a frame, a texture, a video's frame or an environment, by the file's header."""
    picture_bytes: int = 1 << 29
    """Bytes of a picture's or an environment's file."""
    text_bytes: int = 1 << 22
    """Bytes of a scene, a calibration, a response, a list of exposures or an OBJ's material library."""
    mesh_bytes: int = 1 << 28
    """Bytes of a mesh's file, and of each buffer that it names."""
    mesh_elements: int = 20_000_000
    """Vertices, or faces, of a mesh, by the file's header where it has one."""
    scene_entries: int = 2000
    """Tables of one section of a scene: objects, proxies, lights or mirror balls."""
    run_bytes: int = 1 << 30
    """Bytes of what a run of the farm keeps of itself, each file."""
    nesting: int = 64
    """Levels of brackets, tags or indentation in a file."""


def variable_of(name: str) -> str:
    """Environment variable that sets a field of `Limits`."""
    return f"WARP_AR_MAX_{name.upper()}"


def limits() -> Limits:
    """The limits that hold.

    Raises:
        UsageError: An environment variable is no whole number above 0.
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
    """Words for a file that is beyond the limit ``name``."""
    most = getattr(limits(), name)
    return f"{label} has {amount:,} {what}; at most {most:,} are read (set {variable_of(name)} for more)"


def check_size(width: int, height: int, error: type[WarpArError], label: str) -> None:
    """Check the size in pixels that the header of a picture promises.

    Raises:
        WarpArError: As ``error``: it is empty, or too large to be read.
    """
    if width < 1 or height < 1:
        raise error(f"{label} cannot be read: its header promises {width}x{height} pixels")
    if width * height > limits().picture_pixels:
        raise error(too_much(f"{label} is {width}x{height}: it", width * height, "pixels", "picture_pixels"))


def kind_of(path: str | os.PathLike[str]) -> str:
    """Return the kind of thing that a path leads to.

    Returns:
        "file", "folder", "nothing", or words for what is none of them: "a named pipe", "a device", "a socket".

    Raises:
        OSError: The path cannot be looked at, for example because it is too long.
    """
    try:
        mode = os.stat(path).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return "nothing"
    except ValueError as error:  # a zero byte, a half of a pair
        raise OSError(f"the name cannot be one: {reason(error)}") from error
    if stat.S_ISREG(mode):
        return "file"
    if stat.S_ISDIR(mode):
        return "folder"
    return "a named pipe" if stat.S_ISFIFO(mode) else "a socket" if stat.S_ISSOCK(mode) else "a device"


def is_file(path: str | os.PathLike[str], kind: str = "file") -> bool:
    """Tell whether a path leads to a regular file; a path that cannot be one does not."""
    try:
        return kind_of(path) == kind
    except OSError:
        return False


def is_folder(path: str | os.PathLike[str]) -> bool:
    """Tell whether a path leads to a folder; a path that cannot be one does not."""
    return is_file(path, "folder")


def read_bytes(path: str | os.PathLike[str], limit: str, error: type[WarpArError], label: str | None = None) -> bytes:
    """All of a regular file.

    Args:
        path: The file.
        limit: Field of `Limits` that it must keep to, in bytes.
        error: What to raise.
        label: What messages call the file; its path if left out.

    Raises:
        WarpArError: As ``error``: there is no such file, it is no regular one, too large, or cannot be read.
    """
    label = str(path) if label is None else label
    most = getattr(limits(), limit)
    try:
        kind = kind_of(path)
        if kind == "nothing":
            raise error(f"{label} is not there")
        if kind != "file":
            raise error(f"{label} is {'a folder' if kind == 'folder' else kind}; a regular file is needed")
        # Should a pipe take the file's place in between, opening it does not wait either.
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


def read_text(
    path: str | os.PathLike[str], error: type[WarpArError], label: str | None = None, expected: str = "text"
) -> str:
    """All of a regular file in UTF-8; arguments and errors as `read_bytes`, ``expected`` names its format.

    Raises:
        WarpArError: As ``error``: it cannot be read, is too large, or is no text in UTF-8.
    """
    data = read_bytes(path, "text_bytes", error, label)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as problem:
        label = str(path) if label is None else label
        raise error(f"{label}: not a text file in UTF-8 (byte {problem.start}); expected {expected}") from problem


def bracket_depth(text: str) -> int:
    """Most square and curly brackets that are open at once; those within quotes count, so it is never too low."""
    steps = _BRACKETS[np.frombuffer(text.encode("utf-8", "replace"), np.uint8)]
    return int(np.cumsum(steps[steps != 0], dtype=np.int64).max(initial=0))


def indentation_depth(text: str) -> int:
    """Most levels of a block of YAML: each deeper column, and each dash on a line, is one."""
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
    """Most tags of XML that are open at once."""
    depth = deepest = 0
    for match in re.finditer(r"<(/?)[A-Za-z_][^<>]*?(/?)>", text):
        depth += 0 if match[2] else -1 if match[1] else 1
        deepest = max(deepest, depth)
    return deepest


def parse_json(text: str, label: str, error: type[WarpArError]) -> Any:
    """JSON of anyone's making.

    Raises:
        WarpArError: As ``error``: it is damaged, or nested too deeply.
    """
    check_depth(bracket_depth(text), label, error)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as problem:
        raise error(f"{label} cannot be read: {reason(problem)}") from problem


def parse_toml(text: str, label: str, error: type[WarpArError]) -> dict[str, Any]:
    """TOML of anyone's making.

    Raises:
        WarpArError: As ``error``: it is damaged, nested too deeply, or has a dotted key of many parts, each of which is
            a table in a table: TOML's reader takes long.
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
    """Check that a text is not nested too deeply for its reader.

    Raises:
        WarpArError: As ``error``: it is.
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
    """Write a file aside and give it its name when it is whole; what stood there stays until then.

    Args:
        path: The file; a symbolic link is followed. The mode of a file that stood there is kept.
        write: Its bytes, or a function that writes them to the path that it is given.
        suffix: Ending of that path, for libraries that choose the format by it.
        keep_links: Whether other hard links of the file get the new content too; for a user's own file that is amended.

    Raises:
        OSError: It cannot be written; nothing has changed.
    """
    path = pathlib.Path(os.path.realpath(path))
    kind = kind_of(path)
    if kind not in ("file", "nothing"):
        raise OSError(f"it is {'a folder' if kind == 'folder' else kind}, not a file")
    part = name_aside(path, suffix)
    # The name is known before the file is there: a signal between the two leaves nothing.
    try:
        with os.fdopen(create_new(part), "wb") as stream:
            if not callable(write):
                stream.write(write)
        if callable(write):
            write(part)
        before = os.stat(path) if kind == "file" else None
        if before is not None and keep_links and before.st_nlink > 1:
            path.write_bytes(part.read_bytes())  # the copy aside has shown that there is room
            part.unlink()
            return
        if before is not None:
            part.chmod(stat.S_IMODE(before.st_mode) & 0o777)
        take_name(part, path)
    except BaseException:
        with contextlib.suppress(OSError):
            part.unlink()
        raise


def store(
    path: pathlib.Path, write: bytes | Callable[[pathlib.Path], object], *, suffix: str = "", label: str | None = None
) -> None:
    """Write a file as `write_whole` does, and name it where that fails.

    Raises:
        SinkError: It cannot be written; nothing has changed.
    """
    try:
        write_whole(path, write, suffix=suffix)
    except (OSError, RuntimeError) as error:  # RuntimeError: OpenEXR's
        raise SinkError(f"{label or path} cannot be written: {reason(error)}") from error


def name_aside(path: pathlib.Path, suffix: str = "") -> pathlib.Path:
    """Return the path, hidden and of a random name, for a file that is to take another one's name when it is whole.

    Args:
        path: That name (`take_name`).
        suffix: Ending of its name until then.
    """
    name = path.name if len(os.fsencode(path.name)) <= 200 else f"{path.stem[:40]}{path.suffix[:8]}"
    return path.with_name(f".{name}.{secrets.token_hex(8)}.part{suffix}")


def create_new(path: pathlib.Path) -> int:
    """Create an empty file where none is; no link there is followed.

    Returns:
        Its descriptor, open for reading and writing.

    Raises:
        OSError: It cannot be created, or something has that name.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL
    for extra in ("O_NOFOLLOW", "O_CLOEXEC", "O_BINARY"):
        flags |= getattr(os, extra, 0)
    return os.open(path, flags, 0o666)


def take_name(part: pathlib.Path, path: pathlib.Path) -> None:
    """Give a file that was written aside its name; the file that had it is gone.

    Raises:
        OSError: It cannot be renamed.
    """
    part.replace(path)


def is_same_file(a: pathlib.Path, b: pathlib.Path) -> bool:
    """Tell whether two paths lead to one file or folder, by whatever links; neither needs to exist."""
    try:
        return os.path.realpath(a) == os.path.realpath(b) or (os.path.exists(a) and os.path.samefile(a, b))
    except (OSError, ValueError):
        return False
