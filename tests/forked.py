"""Processes for tests to kill: forked from one that has already imported the package, which takes seconds.

As a script it reads a job in JSON from each line, ``{"code": ..., "out": ..., "err": ...}``, forks a process for it,
and prints its number; a line with a number waits for that process, and prints how it ended.
"""

import json
import os
import subprocess
import sys
import textwrap
import time
from pathlib import Path


class Forker:
    """The process that forks, and its children."""

    def __init__(self, folder):
        self._folder, self._count = folder, 0
        self._server = subprocess.Popen(
            [sys.executable, __file__], cwd=Path(__file__).parent, text=True, stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )  # fmt: skip

    def start(self, code, **names):
        """Start a process that runs `code`, in which `names` are known."""
        self._count += 1
        out, err = (self._folder / f"{self._count}.{name}" for name in ("out", "err"))
        job = {"code": textwrap.dedent(code), "out": str(out), "err": str(err), "names": names}
        return Forked(self, int(self.ask(job)), out, err)

    def ask(self, job):
        self._server.stdin.write(json.dumps(job) + "\n")
        self._server.stdin.flush()
        return self._server.stdout.readline()

    def close(self):
        self._server.communicate(timeout=60)


class Forked:
    """One of the children: its number, and its output."""

    def __init__(self, forker, pid, out, err):
        self._forker, self.pid, self._out, self._err = forker, pid, out, err

    def wait(self):
        """Return how it ended, minus the signal that ended it, and its output."""
        code = int(self._forker.ask(self.pid))
        return code, self._out.read_text(), self._err.read_text()

    def until(self, text):
        """Wait for it to print this."""
        end = time.monotonic() + 500
        while text not in self._out.read_text():
            assert time.monotonic() < end, self._err.read_text()
            time.sleep(0.02)


def main():
    sys.path.append(str(Path(__file__).parent / "run"))

    import systems  # noqa: F401  (and with it the package)
    import test_keeping  # noqa: F401

    for line in sys.stdin:
        job = json.loads(line)
        if isinstance(job, int):
            print(os.waitstatus_to_exitcode(os.waitpid(job, 0)[1]), flush=True)
            continue
        open(job["out"], "w").close()
        open(job["err"], "w").close()
        pid = os.fork()
        if pid:
            print(pid, flush=True)
            continue
        for number, name in enumerate((os.devnull, job["out"], job["err"])):
            os.dup2(os.open(name, os.O_RDWR), number)
        exec(compile(job["code"], "<job>", "exec"), {**job["names"]})
        sys.stdout.flush()
        os._exit(0)


if __name__ == "__main__":
    main()
