"""Checks of constructor arguments, with messages that say what is allowed."""

from collections.abc import Iterable
from math import inf
from typing import Any

import numpy as np


def check_choice(name: str, value: Any, allowed: Iterable[Any], where: str = "", form: Any = repr) -> None:
    """Raise ValueError unless ``value`` is one of ``allowed``."""
    choices = tuple(allowed)
    if value not in choices:
        raise ValueError(f"unknown {name} {value!r}{where}; allowed: {', '.join(map(form, choices))}")


def check_range(name: str, value: Any, low: float, high: float | None, whole: bool = False) -> None:
    """Raise ValueError unless ``value`` is a (``whole``) number of ``low`` to ``high``, both included."""
    kinds = (int, np.integer) if whole else (int, float, np.number)
    numeric = isinstance(value, kinds) and not isinstance(value, bool)
    if not numeric or not low <= value <= (inf if high is None else high):
        span = f"at least {low}" if high is None else f"{low} to {high}"
        raise ValueError(f"{name} must be {'a whole number' if whole else 'a number'} of {span}, not {value!r}")
