"""Modules that the server imports once, so that its forked runs need not import and compile anything."""

import tqdm

tqdm.tqdm.monitor_interval = 0  # no thread: it would be lost by a fork, with what it holds

from . import runs  # noqa: E402

for kind in runs.SINGLE:
    runs.whole(kind)
