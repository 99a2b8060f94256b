"""Add to a Windows Python what its tests under Wine need.

    python complete.py WINE_DLL PYTHON_FOLDER SITE_FOLDER

NumPy and SciPy import complex functions from api-ms-win-crt-math-l1-1-0.dll. Wine replaces that library with its own,
WINE_DLL, which lacks them. A library of another name of the same length contains them and forwards all others; it is
put next to python.exe, and its name is written into the modules of SITE_FOLDER. The Python of the Maven package lacks
python3.dll, through which modules with the stable interface find python312.dll. Nothing of this
is shipped.
"""

import re
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path

SOURCE = Path(__file__).with_name("complex_math.c")
LACKING, OURS = b"api-ms-win-crt-math-l1-1-0.dll", b"eip-ms-win-crt-math-l1-1-0.dll"


def listed(library: Path) -> str:
    """Return what objdump prints about a library."""
    return subprocess.run(["objdump", "-p", library], capture_output=True, text=True, check=True).stdout


def exported(library: Path) -> set[str]:
    """Return the names that a library exports."""
    return set(
        re.findall(r"^\s*\[\s*\d+\] (?:\+base\[\s*\d+\]\s+[0-9a-f]+ )?([A-Za-z_]\w*)$", listed(library), re.MULTILINE)
    )


def imported(module: Path) -> set[str]:
    """Return the names that a module imports from the library that Wine replaces."""
    names = set()
    for block in re.findall(r"DLL Name: (?:api|eip)-ms-win-crt-math\S+\n(.*?)\n\n", listed(module), re.DOTALL):
        names |= set(re.findall(r"^\t[0-9a-f]+\s+\d+\s+(\w+)$", block, re.MULTILINE))
    return names


def functions() -> set[str]:
    """Return the names of the functions in complex_math.c."""
    text = SOURCE.read_text(encoding="utf-8")
    three = re.findall(r"^(?:REAL|COMPLEX)\((\w+), ", text, re.MULTILINE)
    return {*re.findall(r"wine_(\w+)\(", text), *(name + kind for name in three for kind in ("", "f", "l"))}


def link(library: Path, exports: Mapping[str, str], sources: Iterable[Path] = ()) -> None:
    """Build a library whose exports have these targets."""
    with tempfile.TemporaryDirectory() as folder:
        lines = [f"  {name}={target}" for name, target in sorted(exports.items())]
        definitions, built = Path(folder, "names.def"), Path(folder, library.name)
        definitions.write_text("\n".join([f"LIBRARY {library.name}", "EXPORTS", *lines, ""]), encoding="utf-8")
        zig = [sys.executable, "-m", "ziglang", "cc", "-target", "x86_64-windows-gnu", "-mcpu=baseline", "-O1"]
        subprocess.run([*zig, "-shared", *sources, definitions, "-o", built], check=True)
        library.write_bytes(built.read_bytes())


def main(wine: Path, python: Path, site: Path) -> None:
    """Build both libraries, and write the name of the first into the modules."""
    modules = [p for p in site.rglob("*") if p.suffix in (".pyd", ".dll") and LACKING[3:] in p.read_bytes()]
    needed, own = set().union(*(imported(path) for path in modules)), functions()
    if absent := needed - own - exported(wine):
        raise SystemExit(f"neither Wine nor {SOURCE.name} has {', '.join(sorted(absent))}")
    exports = {name: f"wine_{name}" if name in own else f"ucrtbase.{name}" for name in needed}
    link(python / OURS.decode(), exports, [SOURCE])
    for path in modules:
        path.write_bytes(path.read_bytes().replace(LACKING, OURS))
    (whole,) = python.glob("python3??.dll")
    link(python / "python3.dll", {name: f"{whole.stem}.{name}" for name in exported(whole)}, [SOURCE])
    print(f"{len(modules)} modules import {len(needed)} functions, {len(needed & own)} of them from {SOURCE.name}")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
