"""How far is a run? Models that are done, and rate and time that is left by the size of their input."""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import Self

from tqdm import tqdm

from sfm_audit.loaders import ModelRef


class Progress:
    """A bar on stderr while models are audited; use as a context manager.

    Models differ in size by a thousand, so the bar counts bytes of input, which the time an audit takes follows.

    Parameters
    ----------
    refs : the models of the run            silent : whether to show nothing
    """

    def __init__(self, refs: Sequence[ModelRef], *, silent: bool) -> None:
        self._num_models = len(refs)
        self._num_done = 0
        num_bytes = sum(ref.num_bytes for ref in refs)
        self._bar = tqdm(total=num_bytes, unit="B", unit_scale=True, disable=silent, desc=self._models())

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the bar as it stands."""
        self._bar.close()

    def skip(self, ref: ModelRef) -> None:
        """Count a model that needs no audit; the rate does not count it."""
        self.advance(ref)
        self._bar.initial = self._bar.n

    def advance(self, ref: ModelRef) -> None:
        """Count a model."""
        self._num_done += 1
        self._bar.set_description_str(self._models(), refresh=False)
        self._bar.update(ref.num_bytes)

    def _models(self) -> str:
        return f"{self._num_done}/{self._num_models} models"
