"""scripts/build_kernels.py: which compiler, for which systems a library is, and of which sources."""

import ctypes
import importlib.util
import platform
import shutil
import sys
import sysconfig
from pathlib import Path

import pytest

from sfm_audit.audit.kernels.library import sources_hash

ROOT = Path(__file__).resolve().parents[2]
_spec = importlib.util.spec_from_file_location("build_kernels", ROOT / "scripts" / "build_kernels.py")
build_kernels = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(build_kernels)
needs_compiler = pytest.mark.skipif(not any(map(shutil.which, build_kernels.COMPILERS)), reason="no C compiler")


@pytest.fixture
def glibc(monkeypatch):
    monkeypatch.setattr(sysconfig, "get_platform", lambda: "linux-x86_64")
    monkeypatch.setattr(platform, "libc_ver", lambda: ("glibc", "2.36"))
    monkeypatch.setattr(sys, "platform", "linux")


@pytest.mark.usefixtures("glibc")
@pytest.mark.parametrize(
    ("content", "tag"),
    [
        (b"\0libm.so.6\0libc.so.6\0GLIBC_2.29\0GLIBC_2.2.5\0GLIBC_2.14\0", "manylinux_2_29_x86_64"),
        (b"\0libc.so.6\0GLIBC_2.2.5\0", "manylinux_2_17_x86_64"),
        (b"\0nothing\0", "manylinux_2_17_x86_64"),
        (b"\0libc.so.6\0libgomp.so.1\0GLIBC_2.29\0", "linux_x86_64"),
        (b"\0libc.musl-x86_64.so.1\0", "linux_x86_64"),
        (b"\0libc.so.6\0GLIBC_ABI_DT_RELR\0GLIBC_2.29\0", "linux_x86_64"),
    ],
)
def test_a_tag_names_the_systems_that_have_what_a_library_asks_for(content, tag, tmp_path):
    path = tmp_path / "compiled.so"
    path.write_bytes(content)
    assert build_kernels.platform_tag(path) == tag


@pytest.mark.usefixtures("glibc")
def test_without_glibc_or_linux_the_tag_promises_no_manylinux(tmp_path, monkeypatch):
    path = tmp_path / "compiled.so"
    path.write_bytes(b"")
    monkeypatch.setattr(platform, "libc_ver", lambda: ("", ""))
    assert build_kernels.platform_tag(path) == "linux_x86_64"
    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.setattr(platform, "machine", lambda: "arm64")
    assert build_kernels.platform_tag(path) == "macosx_11_0_arm64"


@pytest.fixture
def sources(tmp_path, monkeypatch):
    """Two small sources: all kernels take ten seconds to compile."""
    folder = tmp_path / "source"
    folder.mkdir()
    for name in ("kernel.h", "version.c"):
        shutil.copy(build_kernels.SOURCES / name, folder)
    (folder / "one.c").write_text('#include "kernel.h"\nKERNEL int64_t one(double *x) { x[0] = 1.0; return DONE; }\n')
    monkeypatch.setattr(build_kernels, "SOURCES", folder)
    return folder


@needs_compiler
def test_a_library_carries_the_hash_of_its_sources(tmp_path, monkeypatch, sources):
    monkeypatch.delenv("CC", raising=False)
    path = tmp_path / "built" / "compiled.so"
    path.parent.mkdir()
    assert build_kernels.is_stale(path)
    assert build_kernels.build(path) is None
    assert not build_kernels.is_stale(path)
    assert build_kernels.sources_hash() == sources_hash(sources) != sources_hash()
    assert [each.name for each in path.parent.iterdir()] == ["compiled.so"]
    assert ctypes.CDLL(str(path)).one((ctypes.c_double * 1)()) == 0
    first = path.read_bytes()
    assert build_kernels.build(path) is None
    assert path.read_bytes() == first
    (sources / "one.c").write_text('#include "kernel.h"\n')
    assert build_kernels.is_stale(path)
    (sources / "one.c").write_text("no C\n")
    assert "error" in build_kernels.build(path)
    assert path.read_bytes() == first


@needs_compiler
@pytest.mark.usefixtures("sources")
def test_cc_is_the_compiler_with_its_arguments(tmp_path, monkeypatch):
    (name,) = [name for name in build_kernels.COMPILERS if shutil.which(name)][:1]
    monkeypatch.setenv("CC", f"{name} -DONE '-DWORDS=1 + 1'")
    assert build_kernels.compiler() == [name, "-DONE", "-DWORDS=1 + 1"]
    assert build_kernels.build(tmp_path / "compiled.so") is None


@pytest.mark.parametrize(
    ("machine", "source", "flags"),
    [
        ("x86_64", "joint_scores", ["-mavx2", "-mfma", "-ffp-contract=fast"]),
        ("AMD64", "misfit", ["-mavx2", "-mfma", "-ffp-contract=fast"]),
        ("x86_64", "tracks", ["-mavx2", "-mfma", "-ffp-contract=off"]),
        ("x86_64", "version", ["-ffp-contract=off"]),  # asked whether the others can run
        ("arm64", "joint", ["-ffp-contract=fast"]),
        ("aarch64", "spread", ["-ffp-contract=off"]),
        ("ppc64le", "joint", ["-ffp-contract=off"]),
    ],
)
def test_products_and_sums_are_fused_where_every_processor_can(monkeypatch, machine, source, flags):
    monkeypatch.setattr(platform, "machine", lambda: machine)
    assert build_kernels.processor_flags(source) == flags


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("false", "false failed: exit code 1"),
        ("no-such-compiler -m64", build_kernels.NO_COMPILER),
        ("'cc", build_kernels.NO_COMPILER),
        ("{folder}/not-a-program", "cannot be used: "),
    ],
)
def test_a_compiler_that_cannot_is_one_reason_and_no_file(command, said, tmp_path, monkeypatch):
    broken = tmp_path / "not-a-program"
    broken.write_bytes(b"\x7fELF")
    broken.chmod(0o755)
    monkeypatch.setenv("CC", command.format(folder=tmp_path))
    assert said in build_kernels.build(tmp_path / "compiled.so")
    assert [each.name for each in tmp_path.iterdir()] == ["not-a-program"]


def test_a_compiler_that_hangs_is_left(tmp_path, monkeypatch):
    hangs = tmp_path / "hangs"
    hangs.write_text("#!/bin/sh\nexec sleep 60\n")
    hangs.chmod(0o755)
    monkeypatch.setenv("CC", str(hangs))
    monkeypatch.setattr(build_kernels, "LIMIT_SECONDS", 0.2)
    assert "timed out" in build_kernels.build(tmp_path / "compiled.so")
