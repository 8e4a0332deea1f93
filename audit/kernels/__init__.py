"""Compiled loops for what numpy does slowly; every one has a numpy twin that stays the definition (docs/kernels.md)."""

from sfm_audit.audit.kernels.library import KernelError, Path, kernels_in_use, numpy_only, path_taken

__all__ = ["KernelError", "Path", "kernels_in_use", "numpy_only", "path_taken"]
