"""Hook of the build back end: the compiled kernels, where there is a C compiler, are a part of the installation.

SFM_AUDIT_KERNELS, as the program itself reads it: 0 builds none (a wheel py3-none-any for every machine), 1 insists on
them (the build fails where they cannot be compiled). Otherwise they are tried, and a failure is a warning.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from scripts import build_kernels

VARIABLE = "SFM_AUDIT_KERNELS"


class CustomBuildHook(BuildHookInterface[Any]):
    """Put the library into the wheel, or beside the sources of an editable installation."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build before files are collected."""
        wanted = os.environ.get(VARIABLE, "")
        if self.target_name != "wheel" or wanted == "0":
            return
        editable = version == "editable"
        # Otherwise not into the sources, which may not be ours to write.
        self._scratch = tempfile.TemporaryDirectory()
        library = build_kernels.LIBRARY if editable else Path(self._scratch.name) / build_kernels.LIBRARY.name
        problem = build_kernels.build(library)
        if problem is not None:
            if wanted == "1":
                self.app.abort(f"{VARIABLE}=1, but there are no compiled kernels: {problem}")
            self.app.display_warning(f"sfm-audit is installed without compiled kernels (slower): {problem}")
            return
        if editable:
            return
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{build_kernels.platform_tag(library)}"
        build_data["force_include"][str(library)] = f"sfm_audit/audit/kernels/{library.name}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove what was built beside the wheel that now holds it."""
        del version, build_data, artifact_path
        if hasattr(self, "_scratch"):
            self._scratch.cleanup()
