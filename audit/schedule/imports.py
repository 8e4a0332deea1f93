"""Import what audits, and nothing of numpy that SciPy asks for only to have a copy of all its names.

`scipy._lib.array_api_compat` clones numpy: it asks for every name, also those of subpackages that numpy itself imports
when they are first asked for. Four of them take 0.05 s and 7 MB of every process, and neither SciPy's functions on
arrays nor we use them.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from sfm_audit.audit.schedule.garbage import importing

_COPIED_FOR_NOTHING: Final = frozenset({"f2py", "ma", "polynomial", "testing"})
_LISTS: Final = ("__all__", "__numpy_submodules__")  # what ``import *`` and ``dir`` name


@contextmanager
def importing_audits() -> Iterator[None]:
    """Import inside without collecting garbage; numpy does not name the four meanwhile, and has them when asked."""
    with importing():
        import numpy as np  # noqa: PLC0415 - not where nothing is audited

        named = {name: getattr(np, name) for name in _LISTS if hasattr(np, name)}
        try:
            for name, names in named.items():
                setattr(np, name, type(names)(each for each in names if each not in _COPIED_FOR_NOTHING))
            yield
        finally:
            for name, names in named.items():
                setattr(np, name, names)
