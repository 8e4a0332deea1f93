"""Which of the known words did the user mean? For messages about words that are not known."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from typing import Final

_MAX_CHARACTERS: Final = 200  # of a word that is compared: difflib takes the product of both lengths
_MAX_KNOWN: Final = 2_000


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return ", did you mean X?" for the most similar of the known words; nothing where none is similar."""
    if len(word) > _MAX_CHARACTERS:
        return ""
    short = [name for name in known if len(name) <= _MAX_CHARACTERS][:_MAX_KNOWN]
    same = [name for name in short if name.casefold() == word.casefold()]
    close = same or get_close_matches(word, short, n=1)
    return f", did you mean {close[0]}?" if close else ""
