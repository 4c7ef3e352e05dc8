"""Copies of objects that keep a state between blocks."""

from __future__ import annotations

import copy
from typing import Any


class OwnState:
    """Base of classes whose copies share no memory with the original, whether by `copy`, `deepcopy` or `pickle`.

    A pickle alone does not ensure this: readers of pickles (joblib, Dask) map arrays from files or messages that are
    shared and cannot be written, while kernels write to the arrays of a state. A state that cannot be copied, such as
    an open file or a lock in a plugin, is a TypeError.
    """

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(copy.deepcopy(state))
