"""`numba.njit` whose cache on disk is never a reason to fail."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from typing import Any

import numba
from numba.core import sigutils
from numba.core.caching import FunctionCache

__all__ = ["cached_njit"]


def cached_njit(signatures: Any = None, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """As ``numba.njit(signatures, cache=True, **options)``, for a cache that may not be there.

    Numba raises an error, at import, where neither the folder of a function nor the user's cache can be written to, as
    in a read-only installation without a home; and when the disk is full, or a file of the cache is damaged. Here the
    function is then compiled in each process, which is told once. Of two processes that compile the same function at
    once for different types, one may find the other's under its own name later: that is seen too.

    Parameters
    ----------
    signatures : signature or list of them, optional
    **options
        Those of `numba.njit`.

    Returns
    -------
    callable
        The decorator.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher: Any = numba.njit(**options)(function)
        if dispatcher is function:  # NUMBA_DISABLE_JIT
            return function
        try:
            dispatcher._cache = _Cache(function)
        except RuntimeError:
            _tell("no folder for them can be written to")
        if signatures is not None:
            for signature in signatures if isinstance(signatures, list) else [signatures]:
                dispatcher.compile(signature)
            dispatcher.disable_compile()
        return dispatcher

    return decorate


class _Cache(FunctionCache):
    """Numba's, but what cannot be read or written, or is not what was asked for, is as if it were not there."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            found = super().load_overload(sig, target_context)
        except Exception:  # whatever the unpickling of a damaged file raises
            with suppress(OSError):
                self.flush()
            return None
        wanted, _ = sigutils.normalize_signature(sig)
        return found if found is None or found.signature.args == wanted else None

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _tell((error.strerror or str(error)).lower())


@cache
def _tell(why: str) -> None:
    warnings.warn(
        f"compiled functions cannot be kept on disk ({why}), and each process compiles them anew, for a minute or two. "
        "Set NUMBA_CACHE_DIR to a folder that can be written to.",
        RuntimeWarning,
        stacklevel=2,
    )
