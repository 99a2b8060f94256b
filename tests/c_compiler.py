"""The C compiler that builds the package, for tests of C functions."""

import os
import shlex
import subprocess
import sysconfig

FLAGS = ["-O2", "-ffp-contract=off", "-shared", "-fPIC"]


def compiler():
    """The words of its command."""
    return shlex.split(os.environ.get("CC") or sysconfig.get_config_var("CC"))


def shared_library(path, *sources):
    """The library of C sources at `path`."""
    subprocess.run([*compiler(), *FLAGS, "-o", str(path), *map(str, sources), "-lm"], check=True)
    return path
