"""Builds the native engine (pyproject.toml has all else).

One module for every processor, and on x86-64 another for those with AVX2 and FMA; eip_scipy/engine/native.py chooses.
"""

import hashlib
import os
import platform
import shlex
import sys
import sysconfig
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, ClassVar

import nanobind
import numpy
from setuptools import Extension, find_packages, setup
from setuptools.command.build_ext import build_ext

from building.compiler import chosen

FOLDER = Path("eip_scipy/engine/cpp")
# Called once a run, or by Python: these are compiled in half the time without the passes that make loops fast.
COLD = ["complex_step.cpp", "library.cpp", "module.cpp", "python_functions.cpp", "records.cpp"]
# The library of nanobind is compiled once and linked into both modules: what differs between these, the NB_DOMAIN that
# keeps their types apart, stands in its headers only.
NANOBIND = Path(nanobind.include_dir()).parent
INCLUDED = [str(NANOBIND / "include"), str(NANOBIND / "ext" / "robin_map" / "include")]
COMPILER = chosen()
# No fused operation but those that are written, no reordering: the same bits from every build. The warnings left
# out are about Python's own interface.
FLAGS = ["-std=c++20", "-O3", "-g0", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math"]
FLAGS += ["-fvisibility=hidden", "-Wall", "-Wextra", "-Wno-cast-function-type", "-Wno-missing-field-initializers"]
EVERY, V3, QUICK, OLD = [*COMPILER.every], [*COMPILER.v3], "-O1", "-O1"
# Not our headers: without warnings. The library handles Python's objects under several types.
OTHERS = [f"-isystem{path}" for path in INCLUDED]
OTHERS_OWN = ["-std=c++20", "-g0", "-w", "-fvisibility=hidden", "-fno-strict-aliasing", "-ffunction-sections", *EVERY]
UNUSED = ["-Wl,-dead_strip" if sys.platform == "darwin" else "-Wl,--gc-sections"]  # most of it is
MISSING = f"""\
eip_scipy's engine is written in C++20, and {shlex.join(COMPILER.command)!r} did not build it. g++ 12 or newer, clang 15
or newer and Xcode's tools do, and so does the package ziglang: set EIP_SCIPY_COMPILER=zig, or to another command."""
HEADERS = """\
eip_scipy's engine is built with Python's headers, and this Python came without them: no Python.h in {folder}.
Debian and Ubuntu have them in python3-dev, Fedora in python3-devel; Pythons from elsewhere bring them."""

# For .ci: a folder with modules built before. Those of other sources are refused when they are imported.
BUILT = os.environ.get("EIP_SCIPY_BUILT")


def stamp() -> str:
    """Hash of the engine's sources, by which a build that is older than they are is known."""
    files = sorted(path for path in FOLDER.rglob("*") if path.suffix in (".cpp", ".hpp"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()


def module(name: str, *flags: str) -> Extension:
    """One build of the engine."""
    return Extension(
        f"eip_scipy.engine.{name}",
        sources=[str(path) for path in sorted(FOLDER.rglob("*.cpp"))],
        depends=[str(path) for path in sorted(FOLDER.rglob("*.hpp"))],
        include_dirs=[numpy.get_include()],
        define_macros=[("EIP_MODULE", name), ("NB_DOMAIN", name), ("EIP_SOURCES", f'"{stamp()}"')],
        extra_compile_args=[*FLAGS, *OTHERS, *flags],
        extra_link_args=UNUSED,
        language="c++",
    )


class Build(build_ext):
    """Builds the modules side by side, and says what is missing where no compiler can be had."""

    # A compiler for each core, whatever file of whichever module it is.
    pool = ThreadPoolExecutor(os.cpu_count())
    binding: ClassVar[list[Future[list[str]]]] = []  # nanobind's library

    def finalize_options(self) -> None:
        """A thread for each module, unless another number is asked for."""
        super().finalize_options()
        if self.parallel is None:
            self.parallel = True

    def build_extensions(self) -> None:
        """Build all, the library of nanobind before them."""
        self.compiler.set_executables(**COMPILER.executables)
        if not BUILT and self.extensions:
            folder = Path(sysconfig.get_path("include"))
            if not (folder / "Python.h").exists():
                raise SystemExit(HEADERS.format(folder=folder))
            source, macros = NANOBIND / "src" / "nb_combined.cpp", [("NB_COMPACT_ASSERTIONS", None)]
            folders = [*self.include_dirs, *INCLUDED]
            self.binding.append(self.compiled("nanobind", [str(source)], macros, folders, [*OTHERS_OWN, QUICK])[0])
        super().build_extensions()

    def compiled(
        self, name: str, sources: list[str], macros: list[Any], folders: list[str], flags: list[str]
    ) -> list[Future[list[str]]]:
        """Start to compile files into a folder of that name."""
        where = str(Path(self.build_temp) / name)
        options = {"output_dir": where, "macros": macros, "include_dirs": folders, "extra_postargs": flags}
        return [self.pool.submit(self.compiler.compile, [source], **options) for source in sources]

    def build_extension(self, ext: Extension) -> None:
        """One module, with objects of its own."""
        if BUILT:
            path = self.get_ext_fullpath(ext.name)
            self.mkpath(str(Path(path).parent))
            self.copy_file(str(Path(BUILT, Path(path).name)), path)
            return
        hot = sorted((source for source in ext.sources if Path(source).name not in COLD), key=_longest_first)
        cold = [source for source in ext.sources if source not in hot]
        given = ext.define_macros, ext.include_dirs
        try:
            # The cold ones are linked after the others: of a function that both have, the fast one is taken.
            jobs = self.compiled(ext.name, hot, *given, ext.extra_compile_args)
            jobs += self.compiled(ext.name, cold, *given, [*ext.extra_compile_args, QUICK])
            ext.extra_objects = [path for job in [*jobs, *self.binding] for path in job.result()]
            ext.sources = []
            super().build_extension(ext)
        except Exception as error:
            raise SystemExit(f"{MISSING}\nWhat the build said: {error}") from error


def _longest_first(source: str) -> int:
    """Put the file that takes longest first."""
    return Path(source).name != "engine.cpp"


builds: dict[str, list[str]] = {"_native": EVERY}
if platform.machine().lower() in ("x86_64", "amd64"):
    # What is left to the first are processors of 2012 and before, which call a function for a fused operation: of the
    # optimizer the least, which spares a third of its compilation.
    builds = {"_native": [*EVERY, OLD], "_native_v3": V3}
# For .ci: one of them, and further flags; or none, where the package is looked at and not run.
if only := os.environ.get("EIP_SCIPY_BUILD"):
    name, *further = only.split()
    builds = {} if name == "none" else {name: [*builds[name], *further]}
setup(
    packages=[
        *find_packages(include=["eip_scipy", "eip_scipy.*"]),
        "eip_scipy.integrations",
        *find_packages("studies"),
    ],
    ext_modules=[module(name, *flags) for name, flags in builds.items()],
    cmdclass={"build_ext": Build},
)
