"""The answer about one reconstruction: its tables as data frames, and each image by name."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pandas as pd
from threadpoolctl import threadpool_limits

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.engine.image import ImageAudit
from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.engine.tables import ModelAudit
from sfm_audit.audit.notebook.residuals import image_residuals_of
from sfm_audit.audit.notebook.story import story_of
from sfm_audit.audit.table.words import Verdict
from sfm_audit.loaders.model import SparseModel
from sfm_audit.reports.text.brief import brief_html, brief_image, brief_image_html, brief_line
from sfm_audit.reports.text.reasons import reasons_of
from sfm_audit.reports.text.wording import plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_EXAMPLES: Final = 3


class Text(str):
    """Text that a notebook shows as it is, line by line, where it is the last value of a cell."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


class ReconstructionAudit:
    """What the audit says of one reconstruction; made by `sfm_audit.audit_reconstruction`.

    Attributes
    ----------
    tables : ModelAudit
        Arrow tables, as a run folder holds them (docs/tables.md).
    model : SparseModel
        What was audited.
    config : AuditConfig
        With which settings.
    """

    def __init__(self, auditor: ModelAuditor, tables: ModelAudit) -> None:
        self._auditor = auditor
        self.tables = tables

    @property
    def model(self) -> SparseModel:
        """The model that was audited."""
        return self._auditor.model

    @property
    def config(self) -> AuditConfig:
        """The settings that it was audited with."""
        return self._auditor.config

    @cached_property
    def images(self) -> pd.DataFrame:
        """One row per registered image; made when it is first asked for."""
        return self.tables.images.to_pandas()

    @cached_property
    def cameras(self) -> pd.DataFrame:
        """One row per camera that has an image with inliers."""
        return self.tables.cameras.to_pandas()

    @cached_property
    def models(self) -> pd.DataFrame:
        """One row: the model."""
        return self.tables.models.to_pandas()

    def image(self, name: str) -> ImageResult:
        """Return what is said of one image.

        Parameters
        ----------
        name : its name, or ``id:<image_id>`` where several images have one name

        Raises
        ------
        KeyError
            There is no such image, or more than one.
        TypeError
            ``name`` is no text.
        """
        if not isinstance(name, str):
            raise TypeError(f"name: expected an image's name or id:<image_id> as text, found {name!r:.40}")
        names = self.model.images.name
        same = [i for i, each in enumerate(names) if each == name]
        if len(same) > 1:
            ids = ", ".join(f"id:{self.model.images.image_id[i]}" for i in same[:_EXAMPLES])
            raise KeyError(f"{len(same)} images are called {plain(name)!r}; name one by its id ({ids})")
        try:
            image_idx = self.model.image_idx(name)
        except KeyError:
            some = ", ".join(plain(each) for each in names[:_EXAMPLES])
            raise KeyError(f"no image {plain(name)!r}; there are {some} ... (or id:<image_id>)") from None
        row = self.tables.images.slice(image_idx, 1).to_pylist()[0]
        return ImageResult(self._auditor, image_idx, row, self._model_row)

    def __repr__(self) -> str:
        return f"<{brief_line(self._verdicts(), self._model_row, self.config.policy)}>"

    def _repr_html_(self) -> str:
        rows = self.tables.images.select(["image_name", "verdict", "reasons"]).to_pylist()
        return brief_html(self._verdicts(), self._model_row, self.config.policy, rows)

    def _verdicts(self) -> Counter[str]:
        return Counter(str(verdict) for verdict in self.tables.images.column("verdict").to_pylist())

    @property
    def _model_row(self) -> dict[str, Any]:
        return dict(self.tables.models.to_pylist()[0])


class ImageResult:
    """What the audit says of one image; made by `ReconstructionAudit.image`.

    Attributes
    ----------
    row : dict
        Its row of the table ``images`` (docs/tables.md).
    """

    def __init__(self, auditor: ModelAuditor, image_idx: int, row: dict[str, Any], model_row: dict[str, Any]) -> None:
        self._auditor = auditor
        self._image_idx = image_idx
        self._model_row = model_row
        self.row = row

    @property
    def name(self) -> str:
        """The image's name."""
        return str(self.row["image_name"])

    @property
    def verdict(self) -> Verdict:
        """The verdict of the policy."""
        return Verdict(self.row["verdict"])

    @property
    def reasons(self) -> tuple[str, ...]:
        """Codes of the reasons and remarks, with the numbers that triggered them."""
        return tuple(self.row["reasons"])

    @cached_property
    def audit(self) -> ImageAudit:
        """Everything that was measured, as arrays and records."""
        with quietly():
            return self._auditor.image(self._image_idx)

    def explain(self, width: int = 100) -> Text:
        """Return the whole story as text: why, which questions were asked, and what a verdict does not prove."""
        with quietly():
            return Text(story_of(self._auditor, self._image_idx, self.row, self._model_row, width))

    def plot(self, ax: Axes | None = None, *, magnify: float | None = None) -> Axes:
        """Draw the residuals as arrows over the image, magnified (extra ``report``).

        Parameters
        ----------
        ax : matplotlib axes to draw into; new ones of pyplot's when None
        magnify : length of an arrow in image px per px of residual; by default one that shows the long ones well

        Returns
        -------
        matplotlib.axes.Axes
            The axes that were drawn into: x to the right, y down, px.

        Raises
        ------
        ModuleNotFoundError
            matplotlib is not installed.
        """
        try:
            from sfm_audit.audit.notebook.pictures import plot_residuals  # noqa: PLC0415 - needs an extra
        except ModuleNotFoundError as error:
            if (error.name or "").partition(".")[0] != "matplotlib":
                raise
            wanted = "plot() draws with matplotlib, which is not installed: pip install 'sfm-audit[report]'"
            raise ModuleNotFoundError(wanted, name=error.name) from None
        with quietly():
            residuals = image_residuals_of(self._auditor, self._image_idx, self.row)
        return plot_residuals(residuals, ax, brief_image(self.row, codes=[]), magnify)

    def __repr__(self) -> str:
        return f"<{brief_image(self.row, codes=[reason['code'] for reason in reasons_of(self.row)])}>"

    def _repr_html_(self) -> str:
        return brief_image_html(self.row)


@contextmanager
def quietly() -> Iterator[None]:
    """Matrices are small here, one BLAS thread is the fastest; odd numbers end as NaN, and nothing is said of it."""
    with threadpool_limits(limits=1, user_api="blas"), np.errstate(all="ignore"):
        yield
