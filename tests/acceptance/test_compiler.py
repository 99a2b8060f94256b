"""Which compiler builds the engine."""

import importlib.util
import sys
import sysconfig
from pathlib import Path

import pytest

BUILDING = Path(__file__).parents[2] / "building"


@pytest.fixture
def compiler(monkeypatch):
    """The module as a build finds it, with no variable set."""
    for name in ("EIP_SCIPY_COMPILER", "CXX"):
        monkeypatch.delenv(name, raising=False)
    spec = importlib.util.spec_from_file_location("building_compiler", BUILDING / "compiler.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "building_compiler", module)
    spec.loader.exec_module(module)
    return module


def test_machines_without_a_compiler_bring_one(compiler, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert compiler.required() == ["ziglang>=0.17"]
    # zig builds for the processor at hand otherwise.
    assert compiler.chosen().every == ("-mcpu=baseline",)
    assert compiler.chosen().executables["compiler_so_cxx"][:4] == [sys.executable, "-m", "ziglang", "c++"]


def test_windows_always_brings_one(compiler, monkeypatch):
    monkeypatch.setattr(sys, "platform", "win32")
    assert compiler.required() == ["ziglang>=0.17"]


def test_a_compiler_that_is_too_old_is_passed_over(compiler, monkeypatch, tmp_path):
    old = tmp_path / "old"
    old.write_text("#!/bin/sh\nexit 1\n")
    old.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
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
