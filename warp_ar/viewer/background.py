"""Work beside the frames. Nobody waits for its result, so what fails there is told."""

from __future__ import annotations

import functools
import sys
import traceback
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any

from warp_ar.errors import reason
from warp_ar.viewer.controls import Notify


def begin(helper: Executor, notify: Notify, work: Callable[..., None], *arguments: Any) -> Future[None]:
    """Have a helper do something; an error that it does not catch itself becomes a notice, and the frames go on.

    Args:
        helper: Does it.
        notify: Takes the notice, on the helper's thread.
        work: What is done.
        *arguments: Of ``work``.
    """
    future = helper.submit(work, *arguments)
    future.add_done_callback(functools.partial(_tell, notify))
    return future


def _tell(notify: Notify, future: Future[None]) -> None:
    error = None if future.cancelled() else future.exception()
    if error is None:
        return
    # It is a fault of the program: where it came from is for the terminal.
    traceback.print_exception(error, file=sys.stderr)
    text = f"something beside the frames has failed ({type(error).__name__}: {reason(error)}); the frames go on"
    notify({"type": "notice", "text": text, "bad": True})
