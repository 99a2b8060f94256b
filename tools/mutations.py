#!/usr/bin/env python3
"""Plant faults in the library, one at a time, and see whether the tests find them.

    python tools/mutations.py [--tests CHECKOUT] [--only WORD] [--jobs N]

``tools/faults.json`` has the faults: a file, a text that occurs in it once, the text that replaces it, and the tests
that should fail. They run in copies of this checkout, which must have been built; ``--tests`` takes the tests of
another one. The exit status is 1 if fewer than `ENOUGH`, 55 of 60, are found.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
ENOUGH, SECONDS = 55 / 60, 600
PYTEST = ("-x", "-q", "-n", "0", "-p", "no:cacheprovider", "-m", "not nightly", "--no-header", "--tb=line")


def copied(tests: Path, to: Path) -> Path:
    """Copy the checkout, with the tests and studies of `tests`, and return the copy's path."""
    ignored = shutil.ignore_patterns(".git", ".venv*", "build", "docs", "*_cache", "__pycache__")
    shutil.copytree(ROOT, to, ignore=ignored)
    for folder in ("tests", "studies"):
        shutil.rmtree(to / folder)
        shutil.copytree(tests / folder, to / folder, ignore=ignored)
    return to


def found(fault: dict[str, Any], tree: Path) -> str:
    """Plant a fault in `tree`, run its tests, take it out again; return the first line of the failure, or ""."""
    path = tree / fault["file"]
    text = path.read_text(encoding="utf-8")
    if text.count(fault["old"]) != 1:
        raise ValueError(f"{fault['what']}: its text is {text.count(fault['old'])} times in {fault['file']}")
    tests = [name for name in fault["tests"] if (tree / name).exists()]
    path.write_text(text.replace(fault["old"], fault["new"]), encoding="utf-8")
    try:
        command = [sys.executable, "-m", "pytest", *PYTEST, *(tests or [str(Path(fault["tests"][0]).parent)])]
        environment = os.environ | {
            "PYTHONPATH": f"{tree}{os.pathsep}{tree / 'studies'}",
            "PYTHONDONTWRITEBYTECODE": "1",
        }
        ran = subprocess.run(
            command, cwd=tree, env=environment, capture_output=True, text=True, timeout=SECONDS, check=False
        )
    except subprocess.TimeoutExpired:
        return "the tests do not end"
    finally:
        path.write_text(text, encoding="utf-8")
    lines = [line for line in ran.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return "" if ran.returncode == 0 else (lines or ran.stdout.splitlines()[-1:] or ["failed"])[0]


def main() -> int:
    """Plant all faults; print those that are not found and their number."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--tests", type=Path, default=ROOT, help="checkout whose tests run (default: this one)")
    parser.add_argument("--only", default="", help="only faults whose file or description has this text")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="faults at a time")
    given = parser.parse_args()
    faults = json.loads((ROOT / "tools/faults.json").read_text(encoding="utf-8"))
    chosen = [fault for fault in faults if given.only in fault["file"] + fault["what"]]
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(given.jobs) as pool:
        trees = [copied(given.tests, Path(folder) / str(k)) for k in range(given.jobs)]

        def one(fault: dict[str, Any]) -> str:
            tree = trees.pop()
            try:
                return found(fault, tree)
            finally:
                trees.append(tree)

        missed = 0
        for fault, failure in zip(chosen, pool.map(one, chosen), strict=True):
            print(f"{'found' if failure else 'MISSED':7} {fault['file']}: {fault['what']}  {failure[:90]}", flush=True)
            missed += not failure
    print(f"{len(chosen) - missed} of {len(chosen)} faults found")
    return int(missed > (1 - ENOUGH) * len(chosen))


if __name__ == "__main__":
    sys.exit(main())
