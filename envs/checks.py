"""Checks of constructor arguments, with messages that say what is allowed."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np


def check_choice(name: str, value: Any, allowed: Iterable[Any]) -> None:
    """Raise ValueError unless ``value`` is one of ``allowed``."""
    choices = tuple(allowed)
    if value not in choices:
        raise ValueError(f"unknown {name} {value!r}; allowed: {', '.join(map(repr, choices))}")


def check_range(name: str, value: Any, low: float, high: float, whole: bool = False) -> None:
    """Raise ValueError unless ``value`` is a number (a ``whole`` one) of ``low`` to ``high``, both
    included."""
    kinds = (int, np.integer) if whole else (int, float, np.number)
    if isinstance(value, bool) or not isinstance(value, kinds) or not low <= value <= high:
        kind = "a whole number" if whole else "a number"
        raise ValueError(f"{name} must be {kind} of {low} to {high}, not {value!r}")
