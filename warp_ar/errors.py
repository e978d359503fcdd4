"""Errors that a user can cause, each with a one-line message that says what is wrong and what would be right."""


class WarpArError(Exception):
    """Base of every error that this package raises on purpose; its message is one line, fit to print as it is."""


class SceneError(WarpArError, ValueError):
    """A scene file, or a file it names, cannot be used: names the file, the key and the value."""


class SourceError(WarpArError, RuntimeError):
    """A frame source cannot be opened or has failed."""


class SinkError(WarpArError, RuntimeError):
    """A frame sink cannot be opened or has failed."""


class UsageError(WarpArError, ValueError):
    """An option or argument, on the command line or in a call, has a value that cannot be used."""


def reason(error: BaseException) -> str:
    """What went wrong, on one line, without the path that the message around it names already."""
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return " ".join(str(text).split())
