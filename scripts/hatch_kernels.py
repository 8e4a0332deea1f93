"""Hook of the build back end: the compiled kernels, where there is a C compiler, are a part of the installation."""

from __future__ import annotations

import sys
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

sys.path.insert(0, str(Path(__file__).resolve().parent))
import build_kernels


class CustomBuildHook(BuildHookInterface[Any]):
    """Put the library into the wheel, or beside the sources of an editable installation."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build before files are collected."""
        if self.target_name != "wheel":
            return
        problem = build_kernels.build()
        if problem is not None:
            self.app.display_warning(f"sfm-audit is installed without compiled kernels (slower): {problem}")
            return
        if version == "editable":
            return
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{sysconfig.get_platform().replace('-', '_').replace('.', '_')}"
        build_data["force_include"][str(build_kernels.LIBRARY)] = (
            f"sfm_audit/audit/kernels/{build_kernels.LIBRARY.name}"
        )
