"""What all commands share: exit codes, and errors of usage in one line."""

from __future__ import annotations

import argparse
from typing import NoReturn

from warp_ar.errors import UsageError

EXIT_DONE = 0
EXIT_FAILED = 1
EXIT_USAGE = 2
EXIT_INTERRUPTED = 130


class Parser(argparse.ArgumentParser):
    """Argument parser whose errors are one line, as all errors here are."""

    def error(self, message: str) -> NoReturn:
        """Raise the message as an error of usage."""
        raise UsageError(f"{message}; see {self.prog} --help")


def printable(text: str) -> str:
    """Text from a file or a name, with control characters written out: a terminal would obey them."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
