"""One package in its own process: a request is sent as JSON, and answers are read line by line as they arrive."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from threading import Timer
from time import perf_counter
from typing import Any

WORKER = "eip_scipy_studies.bench.worker"


@dataclass(frozen=True)
class Reply:
    """Answers of a worker, given until its end or until it was stopped.

    `version` is that of the package, None if the worker did not report it. `first` are the seconds from the start of
    the process to its first answer, None if there was none. `failed` is the reason why the worker did not finish, empty
    if it did.
    """

    answers: list[dict[str, Any]]
    version: str | None
    first: float | None
    failed: str


def ask(request: Mapping[str, Any], limit: float, worker: str = WORKER) -> Reply:
    """Start a worker, hand it the request, and read until it ends or `limit` seconds have passed.

    The request has the form that the module `worker` describes. The argument `worker` is the name of the module that is
    run as the process.
    """
    begin = perf_counter()
    # One thread for all: this is a fair comparison, and a problem with threads cannot distort it.
    quiet = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", worker],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            env={**os.environ, **quiet},
        )
        late = Timer(limit, process.kill)
        late.start()
        try:
            answers, first = _read(process, request, begin)
            status = process.wait()
        finally:  # after Ctrl-C too
            late.cancel()
            process.kill()
            process.wait()
        errors.seek(0)
        said = [line.strip() for line in errors.read().splitlines() if line.strip()]
    version = None
    if answers and "version" in answers[-1]:
        version = answers.pop()["version"]
    if status == 0:
        failed = ""
    elif perf_counter() - begin >= limit:
        failed = f"not done after {limit:g} s, and ended"
    else:
        failed = f"the process ended with status {status}{': ' + said[-1] if said else ''}"
    return Reply(answers, version, first, failed)


def _read(
    process: subprocess.Popen[str], request: Mapping[str, Any], begin: float
) -> tuple[list[dict[str, Any]], float | None]:
    assert process.stdin is not None
    assert process.stdout is not None
    with contextlib.suppress(BrokenPipeError):  # the process has died: its status says so
        process.stdin.write(json.dumps(request))
        process.stdin.close()
    answers: list[dict[str, Any]] = []
    first = None
    for line in process.stdout:
        if not line.endswith("\n"):  # stopped within a line
            break
        first = perf_counter() - begin if first is None else first
        answers.append(json.loads(line))
    process.stdout.close()
    return answers, first
