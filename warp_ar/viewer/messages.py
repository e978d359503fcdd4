"""Messages to viewers as plain data: notices, failures, the scene and the plan. ``protocol`` has those from viewers."""

from __future__ import annotations

import contextlib
import re
import sys
import traceback
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any, Final

from warp_ar.errors import WarpArError, reason

Notify = Callable[[dict[str, Any]], None]
"""Receiver of a message for all viewers, called on any thread."""

_LONGEST: Final = 400
"""Characters of a notice about a fault: an exception's text may be a whole file."""
_FOLDERS: Final = re.compile(r"(?<![\w:/.])(?:[A-Za-z]:\\|/)(?:[^\s/\\:;,'\"()]+[/\\])+")
"""Folders of an absolute path: those of this machine are not for viewers; the file's name stays."""


def notice(text: str, *, bad: bool = False) -> dict[str, Any]:
    """Return a notice; ``bad`` marks a refusal or a failure."""
    return {"type": "notice", "text": text, "bad": bad}


def failure(error: BaseException, then: str = "the frames go on") -> dict[str, Any]:
    """Return the notice for an exception; every exception of a frame or of work beside the frames comes here.

    An error of the program's own says what is wrong as it stands. Any other is a fault of the program: its traceback
    goes to the terminal, and viewers are told its type, its text and what happens next.

    Args:
        error: The exception.
        then: What happens next, where the error is a fault.
    """
    if isinstance(error, WarpArError):
        return notice(_FOLDERS.sub("", str(error)), bad=True)
    with contextlib.suppress(OSError, ValueError):  # nobody may read it any more
        traceback.print_exception(error, file=sys.stderr)
    words = _FOLDERS.sub("", reason(error)[:_LONGEST])
    return notice(f"this failed: {type(error).__name__}: {words}; {then}", bad=True)


def begin(helper: Executor, notify: Notify, work: Callable[..., None], *arguments: Any) -> Future[None]:
    """Run work beside the frames; an error that it does not catch itself becomes a notice.

    Args:
        helper: Executor that runs it.
        notify: Receiver of the notice, called on the helper's thread.
        work: Function to run.
        *arguments: Arguments of ``work``.
    """

    def tell(future: Future[None]) -> None:
        if not future.cancelled() and (error := future.exception()) is not None:
            notify(failure(error))

    future = helper.submit(work, *arguments)
    future.add_done_callback(tell)
    return future
