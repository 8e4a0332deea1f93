"""XML files of bounded size, element by element: no document types, no entities, nothing is fetched.

expat, which Python brings, expands entities that a document declares; declaring any is refused here, as defusedxml
does, and so is a document type at all. Elements are dropped as soon as their parent's end is known, so that memory
does not grow with the file.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final
from xml.parsers import expat

from sfm_audit.loaders.errors import MalformedFileError, Position
from sfm_audit.loaders.paths.files import open_input, reading
from sfm_audit.loaders.paths.locations import InputPath

MAX_BYTES: Final = 1 << 33
MAX_DEPTH: Final = 64
MAX_TEXT: Final = 1 << 16
MAX_KEPT: Final = 1 << 20
"""Elements that are kept at a time; elements that are handed over are not kept, so lists of them may be longer."""
MAX_MARKUP: Final = 1 << 23
"""Bytes of one tag or comment: expat keeps what has no end yet."""
_PIECE: Final = 1 << 20


@dataclass(slots=True)
class Element:
    """One element with its text, its children and the line it began at."""

    name: str
    line: int
    text: str = ""
    children: list[Element] = field(default_factory=list)
    num_below: int = 0

    def find(self, name: str) -> Element | None:
        """Return the first child of that name."""
        return next((child for child in self.children if child.name == name), None)

    def value(self, *names: str) -> str | None:
        """Return the text of the element that the names lead to, None where there is none."""
        found: Element | None = self
        for name in names:
            found = found.find(name) if found else None
        return found.text.strip() if found else None


class _Refused(Exception):  # noqa: N818 - a signal out of expat's callbacks
    def __init__(self, wanted: str, got: str) -> None:
        super().__init__(wanted, got)
        self.wanted = wanted
        self.got = got


class _Builder:
    """Builds elements and hands those of certain names over, with the names that lead to them."""

    def __init__(self, root: str, take: frozenset[str], hand: Callable[[Element], None]) -> None:
        self._root = root
        self._take = take
        self._hand = hand
        self._stack: list[Element] = []
        self._num_kept = 0
        self.parser = expat.ParserCreate()
        self.parser.buffer_text = True
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.CharacterDataHandler = self._text
        self.parser.StartDoctypeDeclHandler = self._doctype
        self.parser.EntityDeclHandler = self._entity
        self.parser.ExternalEntityRefHandler = self._external

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        del attributes
        if not self._stack and name != self._root:
            raise _Refused(f"<{self._root}> as the outermost element", f"<{name[:40]}>")
        if len(self._stack) >= MAX_DEPTH:
            raise _Refused(f"at most {MAX_DEPTH} elements inside each other", "more")
        self._stack.append(Element(name, self.parser.CurrentLineNumber))

    def _end(self, name: str) -> None:
        del name
        element = self._stack.pop()
        if element.name in self._take:
            self._hand(element)
            self._num_kept -= element.num_below
        elif self._stack:
            parent = self._stack[-1]
            parent.children.append(element)
            parent.num_below += 1 + element.num_below
            self._num_kept += 1
            if self._num_kept > MAX_KEPT:
                raise _Refused(f"at most {MAX_KEPT} elements in those that have no end yet", "more")

    def _text(self, text: str) -> None:
        if self._stack and not text.isspace():  # blanks between elements would grow with the file
            element = self._stack[-1]
            if len(element.text) + len(text) > MAX_TEXT:
                raise _Refused(f"at most {MAX_TEXT} characters in <{element.name[:40]}>", "more")
            element.text += text

    def _doctype(self, *words: object) -> None:
        del words
        raise _Refused("XML without a document type", "<!DOCTYPE")

    def _entity(self, *words: object) -> None:
        del words
        raise _Refused("XML without entities of its own", "<!ENTITY")

    def _external(self, *words: object) -> int:
        del words
        raise _Refused("XML without entities of its own", "an entity elsewhere")


def check_size(path: InputPath) -> None:
    """Raise MalformedFileError for a file that is too large to be read; other errors as of `open_input`."""
    file, size = open_input(path, only_head=True)
    file.close()
    if size > MAX_BYTES:
        raise MalformedFileError(str(path), None, f"at most {MAX_BYTES} bytes of XML", f"{size}", "split the block")


def read_xml(path: InputPath, root: str, take: frozenset[str], hand: Callable[[Element], None], advice: str) -> None:
    """Parse a file and hand over every element whose name is in ``take``, children first; they are not kept.

    Raises
    ------
    LoadError
        As of `open_input`; MalformedFileError where the file is too large, no XML, has another outermost element, or
        holds what is refused here; errors of ``hand``.
    """
    builder = _Builder(root, take, hand)
    check_size(path)
    file, _ = open_input(path)
    with file, reading(path):
        try:
            num_read = 0
            while piece := file.read(_PIECE):
                builder.parser.Parse(piece, False)
                num_read += len(piece)
                if num_read - builder.parser.CurrentByteIndex > MAX_MARKUP:
                    raise _Refused(f"tags and comments of at most {MAX_MARKUP} bytes", "a longer one")  # noqa: TRY301
            builder.parser.Parse(b"", True)
        except expat.ExpatError as error:
            got = expat.ErrorString(error.code) or "no XML"
            raise MalformedFileError(str(path), Position("line", error.lineno), "XML", got, advice) from None
        except _Refused as error:
            line = Position("line", builder.parser.CurrentLineNumber)
            raise MalformedFileError(str(path), line, error.wanted, error.got, advice) from None
        except (ValueError, LookupError) as error:  # an encoding that Python does not know
            raise MalformedFileError(str(path), None, "XML in UTF-8 or UTF-16", str(error)[:120], advice) from None
