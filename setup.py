"""Builds the native engine (pyproject.toml has all else).

One module for every processor, and on x86-64 another for those with AVX2 and FMA; eip_scipy/engine/native.py chooses.
"""

import hashlib
import os
import shlex
import sysconfig
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, ClassVar

import nanobind
import numpy
from setuptools import Extension, find_packages, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext

from building.compiler import chosen
from building.targets import target

FOLDER = Path("eip_scipy/engine/cpp")
# Called once a run, or by Python: these are compiled in half the time without the passes that make loops fast.
COLD = ["complex_step.cpp", "examination.cpp", "library.cpp", "module.cpp", "python_functions.cpp"]
COLD += ["records.cpp", "states.cpp"]
# These files do not include Python's headers, so that zig, which keeps what it has compiled, compiles them once.
NUMBERS = ["engine.cpp", "forces.cpp", "gravity.cpp", "kepler.cpp", "orbits.cpp", "planets.cpp", "threads.cpp"]
# The library of nanobind is compiled once and linked into both modules: what differs between these, the NB_DOMAIN that
# keeps their types apart, stands in its headers only.
NANOBIND = Path(nanobind.include_dir()).parent
COMPILER, TARGET = chosen(), target()
HERE = Path(sysconfig.get_path("include")), Path(numpy.get_include())
PYTHON, NUMPY = (TARGET.headers / "python", TARGET.headers / "numpy") if TARGET.headers else HERE
INCLUDED = [NANOBIND / "include", NANOBIND / "ext" / "robin_map" / "include", NUMPY, PYTHON]
# No fused operation but those that are written, no reordering: the same bits from every build. The warnings left
# out are about Python's own interface.
FLAGS = ["-std=c++20", "-O3", "-g0", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math"]
FLAGS += ["-fvisibility=hidden", "-Wall", "-Wextra", "-Wno-cast-function-type", "-Wno-missing-field-initializers"]
EVERY, V3, QUICK = [*COMPILER.every], [*COMPILER.v3], "-O1"
OLD = "-Os" if TARGET.system == "win32" else "-O1"  # the wheels of Windows are the largest
# Not our headers: without warnings. The library handles Python's objects under several types.
OTHERS = [f"-isystem{path}" for path in INCLUDED]
if TARGET.stable:
    OTHERS += ["-include", "stdio.h"]  # which Python.h includes in other builds, and nanobind needs
OTHERS_OWN = ["-std=c++20", "-g0", "-w", "-fvisibility=hidden", "-fno-strict-aliasing", "-ffunction-sections", *EVERY]
UNUSED = ["-Wl,-dead_strip" if TARGET.system == "darwin" else "-Wl,--gc-sections"]  # most of it is
# The stable interface as of Python 3.12.
STABLE = [("Py_LIMITED_API", "0x030C0000")] if TARGET.stable else []
# A Python without the global interpreter lock: nanobind locks what it shares, and the modules declare that.
FREE = [("NB_FREE_THREADED", None)] if not TARGET.tag and sysconfig.get_config_var("Py_GIL_DISABLED") else []
if FREE and TARGET.system == "win32":
    FREE += [("Py_GIL_DISABLED", "1")]  # both Pythons have one pyconfig.h there
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
        depends=[str(path) for path in sorted(FOLDER.rglob("*.?pp"))],  # `sources` are compiled before, and taken away
        define_macros=[("EIP_MODULE", name), ("NB_DOMAIN", name), ("EIP_SOURCES", f'"{stamp()}"'), *STABLE, *FREE],
        extra_compile_args=[*FLAGS, *flags],
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
        from distutils.ccompiler import new_compiler  # that of setuptools, which has been imported by now

        if not COMPILER.own:
            self.compiler = new_compiler(compiler="unix")  # on Windows too
            self.compiler.set_executables(**COMPILER.executables)
            self.compiler.set_library_dirs(self.library_dirs)
        if TARGET.headers:
            self.compiler.set_library_dirs([str(TARGET.headers / "libs")] if TARGET.system == "win32" else [])
        self.compiler.set_include_dirs([])  # each file has those that it needs
        if not BUILT and self.extensions:
            if not (PYTHON / "Python.h").exists():
                raise SystemExit(HEADERS.format(folder=PYTHON))
            source, macros = NANOBIND / "src" / "nb_combined.cpp", [("NB_COMPACT_ASSERTIONS", None), *STABLE, *FREE]
            self.binding += self.compiled("nanobind", [str(source)], macros, [*OTHERS_OWN, *OTHERS, QUICK])
        super().build_extensions()

    def compiled(self, name: str, sources: list[str], macros: list[Any], flags: list[str]) -> list[Future[list[str]]]:
        """Start to compile files into a folder of that name."""
        options = {"output_dir": str(Path(self.build_temp) / name), "macros": macros, "extra_postargs": flags}
        return [self.pool.submit(self.compiler.compile, [source], **options) for source in sources]

    def get_ext_filename(self, fullname: str) -> str:
        """Return the path of a module, with the suffix that the target's Python expects."""
        if TARGET.suffix is None:
            return super().get_ext_filename(fullname)
        return str(Path(*fullname.split("."))) + TARGET.suffix

    def get_libraries(self, ext: Extension) -> list[str]:
        """Return the libraries to link: on Windows Python's own."""
        if TARGET.tag is None:
            return super().get_libraries(ext)
        version = "3" if TARGET.stable else TARGET.tag[0].removeprefix("cp")
        return [f"python{version}"] if TARGET.system == "win32" else []

    def build_extension(self, ext: Extension) -> None:
        """One module, with objects of its own."""
        if BUILT:
            path = self.get_ext_fullpath(ext.name)
            self.mkpath(str(Path(path).parent))
            self.copy_file(str(Path(BUILT, Path(path).name)), path)
            return
        numbers = sorted((source for source in ext.sources if Path(source).name in NUMBERS), key=_longest_first)
        cold = [source for source in ext.sources if Path(source).name in COLD]
        others = [source for source in ext.sources if source not in {*numbers, *cold}]
        flags, bound = ext.extra_compile_args, [*ext.extra_compile_args, *OTHERS]
        try:
            # The cold ones are linked after the others: of a function that both have, the fast one is taken.
            jobs = self.compiled(ext.name, numbers, [], flags)
            jobs += self.compiled(ext.name, others, ext.define_macros, bound)
            jobs += self.compiled(ext.name, cold, ext.define_macros, [*bound, QUICK])
            ext.extra_objects = [path for job in [*jobs, *self.binding] for path in job.result()]
            ext.sources = []
            if TARGET.system == "win32":  # keeps the import library, which nothing links, out of the package
                library = Path(self.build_temp, f"{ext.name}.lib")
                ext.extra_link_args = [*ext.extra_link_args, f"-Wl,--out-implib,{library}"]
            if TARGET.system == "darwin" and TARGET.headers:  # not the path that it was linked at
                ext.extra_link_args = [*ext.extra_link_args, f"-Wl,-install_name,{ext.name}"]
            super().build_extension(ext)
        except Exception as error:
            raise SystemExit(f"{MISSING}\nWhat the build said: {error}") from error


class Wheel(bdist_wheel):
    """Builds a wheel that is named after its target."""

    def get_tag(self) -> tuple[str, str, str]:
        """Return the tag of the target, or of this machine."""
        return TARGET.tag or super().get_tag()


def _longest_first(source: str) -> int:
    """Put the file that takes longest first."""
    return Path(source).name != "engine.cpp"


builds: dict[str, list[str]] = {"_native": EVERY}
if TARGET.machine == "x86_64":
    # The first build is for processors of 2012 and before, which call a function for a fused operation: it is compiled
    # with few optimizations, which saves 33 % of its compilation time.
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
    cmdclass={"bdist_wheel": Wheel, "build_ext": Build},
)
