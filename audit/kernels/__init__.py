"""Compiled loops for what numpy does slowly; every one has a numpy twin that stays the definition (docs/kernels.md)."""

from sfm_audit.audit.kernels.library import Path, kernels_in_use, library, numpy_only, path_taken

__all__ = ["Path", "kernels_in_use", "library", "numpy_only", "path_taken"]
