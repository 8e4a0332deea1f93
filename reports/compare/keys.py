"""What do two runs call the same thing? Images and scopes."""

from __future__ import annotations

from typing import NamedTuple


class ImageKey(NamedTuple):
    """What names an image in every reconstruction of the same photos."""

    dataset: str
    scene: str
    image_name: str


Noted = tuple[tuple[ImageKey, str], ...]


class Scope(NamedTuple):
    """A part of a run: all of it, a dataset, or a scene of a dataset."""

    dataset: str | None = None
    scene: str | None = None

    @property
    def kind(self) -> str:
        """Either run, dataset or scene."""
        if self.dataset is None:
            return "run"
        return "dataset" if self.scene is None else "scene"

    @property
    def name(self) -> str:
        """How people call it."""
        return "all" if self.dataset is None else "/".join(part for part in self if part is not None)
