"""How far is a run? Models that are done, and rate and time that is left by the size of their input."""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import TYPE_CHECKING, NoReturn, Self

from sfm_audit.loaders import ModelRef

if TYPE_CHECKING:
    from tqdm import tqdm


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
        self._bar = None if silent else _bar(sum(ref.num_bytes for ref in refs), self._models())

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the bar as it stands."""
        if self._bar is not None:
            self._bar.close()

    def skip(self, ref: ModelRef) -> None:
        """Count a model that needs no audit; the rate does not count it."""
        self.advance(ref)
        if self._bar is not None:
            self._bar.initial = self._bar.n

    def advance(self, ref: ModelRef) -> None:
        """Count a model."""
        self._num_done += 1
        if self._bar is not None:
            self._bar.set_description_str(self._models(), refresh=False)
            self._bar.update(ref.num_bytes)

    def _models(self) -> str:
        return f"{self._num_done}/{self._num_models} models"


def _bar(num_bytes: int, said: str) -> tqdm[NoReturn]:
    from tqdm import tqdm  # noqa: PLC0415 - nobody waits for it who does not see it

    return tqdm(total=num_bytes, unit="B", unit_scale=True, desc=said)
