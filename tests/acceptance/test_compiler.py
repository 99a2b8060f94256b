"""Choice of the compiler that builds the engine, and of its target."""

import importlib
import re
import sys
import sysconfig
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def compiler(monkeypatch):
    """Return the module as a build finds it, with no variable set."""
    for name in ("EIP_SCIPY_COMPILER", "EIP_SCIPY_TARGET", "CXX"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.syspath_prepend(ROOT)
    for name in ("building", "building.targets", "building.compiler"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return importlib.import_module("building.compiler")


def test_machines_without_a_compiler_bring_one(compiler, monkeypatch, tmp_path):
    with monkeypatch.context() as windows:
        windows.setattr(sys, "platform", "win32")
        assert compiler.required() == ["ziglang>=0.17"]
    compiler.chosen.cache_clear()
    monkeypatch.setenv("PATH", str(tmp_path))
    assert compiler.required() == ["ziglang>=0.17"]
    # Otherwise zig builds for the processor of this machine.
    assert compiler.chosen().every == ("-mcpu=baseline",)
    assert compiler.chosen().executables["compiler_so_cxx"][:4] == [sys.executable, "-m", "ziglang", "c++"]
    old = tmp_path / "old"  # which takes no C++ of today
    old.write_text("#!/bin/sh\nexit 1\n")
    old.chmod(0o755)
    compiler.chosen.cache_clear()
    monkeypatch.setenv("CXX", str(old))
    assert compiler.required() == ["ziglang>=0.17"]


def test_the_variable_decides(compiler, monkeypatch):
    monkeypatch.setenv("EIP_SCIPY_COMPILER", "some-clang++ --some-flag")
    assert compiler.chosen().command == ("some-clang++", "--some-flag")
    assert compiler.required() == []
    compiler.chosen.cache_clear()
    monkeypatch.setenv("EIP_SCIPY_COMPILER", "zig")
    assert compiler.required() == ["ziglang>=0.17"]


def test_the_flags_of_packagers_reach_another_compiler(compiler, monkeypatch):
    monkeypatch.setenv("EIP_SCIPY_COMPILER", "zig")
    monkeypatch.setenv("CXXFLAGS", "-DSOME")
    monkeypatch.setenv("LDFLAGS", "-Lsome")
    executables = compiler.chosen().executables
    assert "-DSOME" in executables["compiler_so_cxx"]
    assert "-Lsome" in executables["linker_so_cxx"]


def test_the_compiler_of_python_is_left_to_setuptools(compiler):
    found = compiler.chosen()
    if " ".join(found.command) != sysconfig.get_config_var("CXX"):
        pytest.skip("the compiler that built Python is not here")
    assert found.executables == {}
    assert found.v3 == ("-march=x86-64-v3",)


@pytest.mark.parametrize(
    ("tag", "triple", "suffix"),
    [
        ("cp312-abi3-manylinux_2_28_aarch64", "aarch64-linux-gnu.2.28", ".abi3.so"),
        ("cp311-cp311-manylinux_2_28_x86_64", "x86_64-linux-gnu.2.28", ".cpython-311-x86_64-linux-gnu.so"),
        ("cp312-abi3-win_amd64", "x86_64-windows-gnu", ".pyd"),
        ("cp311-cp311-win_amd64", "x86_64-windows-gnu", ".cp311-win_amd64.pyd"),
        ("cp311-cp311-macosx_12_0_arm64", "aarch64-macos.12.0", ".cpython-311-darwin.so"),
    ],
)
def test_wheels_of_other_platforms(compiler, monkeypatch, tmp_path, tag, triple, suffix):
    """The compiler is that of the platform, and names are Python's there (importlib.machinery.EXTENSION_SUFFIXES)."""
    monkeypatch.setenv("EIP_SCIPY_TARGET", tag)
    monkeypatch.setenv("EIP_SCIPY_HEADERS", str(tmp_path))
    command = compiler.chosen().command
    assert command[command.index("-target") + 1] == triple
    assert ("-undefined" in compiler.chosen().executables["linker_so"]) == ("macos" in triple)
    target = compiler.target()
    assert target.suffix == suffix
    assert "-".join(target.tag) == tag


def test_a_platform_that_is_not_known_is_named(compiler, monkeypatch):
    monkeypatch.setenv("EIP_SCIPY_TARGET", "cp312-abi3-beos")
    with pytest.raises(SystemExit, match="'beos'; expected one of manylinux"):
        compiler.target()


def test_wheels_for_all_versions_of_python_can_be_built():
    """The macros of CPython that look into its objects, such as PyTuple_GET_SIZE, are not in the stable interface."""
    inside = re.compile(r"\bPy(?:ByteArray|Bytes|CFunction|Float|List|Set|Tuple|Unicode)_(?:AS|GET|READ|SET)_[A-Z_]+\(")
    found = [inside.findall(path.read_text()) for path in (ROOT / "eip_scipy/engine/cpp").rglob("*.[ch]pp")]
    assert sum(map(len, found)) == 0, found
    assert len(found) > 40
    assert inside.search("PyTuple_GET_SIZE(x)")
