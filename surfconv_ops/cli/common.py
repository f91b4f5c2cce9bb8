"""What commands share: how they fail, optional packages, kinds of arguments."""

from __future__ import annotations

import argparse
import importlib
import math
from typing import Any


class CommandError(Exception):
    """A message for the user, who sees it without a traceback."""


def need(module: str, package: str) -> Any:
    """An optional package's module, or a message that says how to get it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise CommandError(
            f"{package} is needed here and cannot be imported ({error}); install what the command"
            " line needs with: pip install 'surfconv_ops[cli]'"
        ) from error


def positive(text: str) -> float:
    """A positive number, or a fraction such as 90/65535."""
    top, slash, bottom = text.partition("/")
    try:
        value = float(top) / float(bottom) if slash else float(top)
    except (ValueError, ZeroDivisionError):
        raise argparse.ArgumentTypeError(
            f"expected a number or a fraction such as 1/256, got {text!r}"
        ) from None
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"expected a positive, finite number, got {text!r}")
    return value


def finite(text: str) -> float:
    """A finite number."""
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a number, got {text!r}") from None
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"expected a finite number, got {text!r}")
    return value


def count(text: str) -> int:
    """A whole number from 1."""
    try:
        value = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a whole number, got {text!r}") from None
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected 1 or more, got {value}")
    return value


def counted(number: int, thing: str) -> str:
    """A number of things in words, such as ``2 files``."""
    return f"{number:,} {thing}{'' if number == 1 else 's'}"
